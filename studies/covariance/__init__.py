"""The covariance of holding times, and what truncating its sum leaves out (T4)."""
