"""Tests with real processes and peers: Zenoh, HTTP, MQTT, a database server, kill -9."""
