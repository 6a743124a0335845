"""The vocabulary that the detector and the application manager share: resources and expressions. Pure."""
