"""Tests with what a detector meets: its own processes, real Zenoh, HTTP and MQTT, a database's server, kill -9."""
