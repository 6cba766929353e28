"""What the studies share: reports, figures, samples, simulators."""
