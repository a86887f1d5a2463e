"""Child processes and their shared memory. Each child has one owner, one pipe to it, and ends with it.

`worker`: a child, as seen by its owner, and its main function · `nursery`: the process from which children
are forked, in milliseconds · `shared` memory without a name that could be left behind · `messages` of all
children
"""
