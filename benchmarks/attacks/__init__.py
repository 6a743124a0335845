"""Attacks from one namespace while another is served."""
