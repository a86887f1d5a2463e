"""Proofs about the gateware, for every setting and every length of run, by induction over clocks.

::

    module ──────┐
    assumptions  ├─ Harness ─▶ RTLIL ─▶ yosys: SMT-LIB ─▶ solver ─▶ Verdict
    claims       │
    lemmas ──────┘     base     after reset no claim and no lemma is broken
                       step     if all hold in a clock, they hold in the next, whatever the registers
                       cover    what must be able to happen can: the assumptions do not contradict each other

``python -m firmware.formal`` proves; ``--mutants`` also breaks the gateware one line at a time and
expects each of these to be noticed.
"""
