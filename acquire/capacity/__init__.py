"""What this host sustains: the whole capture path under given loads, and its parts one by one.

`load` what is to be held · `run` it · `latency` of its grabbers · `search` the highest rate without loss ·
`parts` ring, codec and disk by themselves, and whether a configuration can hold
"""
