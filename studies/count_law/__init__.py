"""The law of the count: every simulator (T1), where each law holds, four cumulants, reference cases."""
