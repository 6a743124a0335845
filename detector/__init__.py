"""The detector: buffers the data of vehicles and stations, detects events in it, and runs actions."""
