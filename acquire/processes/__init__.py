"""Child processes and the memory that they share. Each child has one owner, one pipe to it, and ends with it.

`worker` a child, seen from its owner, and its life · `nursery` where children are forked from, in
milliseconds · `shared` memory without a name that could be left behind · `messages` of all children
"""
