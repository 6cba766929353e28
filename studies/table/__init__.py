"""Lookup tables: what they hold, what their lookup costs over their size, what their shape leaves out."""
