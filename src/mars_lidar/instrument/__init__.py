"""The instrument: laser pulse, detector with its effects, histogram, and the system of all of them."""
