"""The sync trigger: what the daemon asks of it, whatever the transport or twin behind."""
