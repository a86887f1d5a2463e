"""Proofs about the gateware, for every setting and every length of run, by induction over clocks.

::

    module ──────┐
    assumptions  ├─ Harness ─▶ RTLIL ─▶ yosys: SMT-LIB ─▶ solver ─▶ Verdict
    claims       │
    lemmas ──────┘     base     after reset no claim and no lemma is broken
                       step     if all hold in a clock, they hold in the next, whatever the registers
                       cover    required situations are reachable: the assumptions are consistent

``python -m firmware.formal`` proves; ``--mutants`` also changes the gateware one line at a time, and expects
a proof to fail for each change.
"""
