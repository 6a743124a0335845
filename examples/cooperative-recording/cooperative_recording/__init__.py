"""The case "cooperative recording": fifteen vehicles on a small road network, six of them with a lidar."""
