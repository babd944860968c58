"""The machine: devices, memory, processes, streams of work."""
