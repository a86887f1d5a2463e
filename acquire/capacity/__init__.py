"""Measure what this host sustains: the whole capture path under given loads, and its parts separately.

`load` defines a load · `run` runs it · `latency` measures its grabbers · `search` finds the highest rate
without loss · `parts` measures ring, codec and disk separately, and so whether a configuration is feasible
"""
