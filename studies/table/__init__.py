"""Lookup tables: what they hold, what their lookup costs, what their shape leaves out."""
