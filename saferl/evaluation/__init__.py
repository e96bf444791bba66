"""Test episodes: played, measured, compared and drawn."""
