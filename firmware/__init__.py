"""The sync trigger's gateware (Amaranth 0.5), one module per file, and its twin that runs as compiled C++.

::

    uart -> deframer -> host (READ, WRITE, ...) -> framer -> uart        everything a host can say
                          |        ^       ^
                       settings  status   tag queue <--- tagger
                          v        |                       ^
    start --> timing --> line, sub-step, light strobes ----+--> camera pulses A, B; phases; LED

All of it runs in one clock domain. `acquire.trigger.registers` is the only definition of addresses and
layouts; `top.SyncTrigger` puts the modules together and knows no board.
"""
