"""What each mode and each effect of a detector does to the same light."""
