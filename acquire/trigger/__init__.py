"""The sync trigger: its interface to the daemon, and the driver for any transport or twin."""
