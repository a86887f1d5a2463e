"""The boards: which pin is what, where the 90 MHz come from, and how a bitstream or a netlist is made."""
