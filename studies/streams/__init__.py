"""Ideal streams over the whole range of light, jitter and clock: false alarms, and how well stated errors hold."""
