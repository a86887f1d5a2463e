"""The boards: assignment of pins, source of the 90 MHz, and generation of a bitstream or a netlist."""
