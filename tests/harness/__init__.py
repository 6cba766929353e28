"""One statistical harness for all engines.

`check(engine, case, oracle, ...)` draws realizations with a fixed seed and compares them with an oracle: an
independent simulator's statistics (`Reference`), a closed form (`Law`, `JointLaw`) or another engine's draws (any
`Engine`). An engine declares what it claims to reproduce (`COUNTS`, `SHAPE`, `JOINT`, `INTERVALS`); nothing
else is asked of it.

Every comparison yields one p-value of known size, and every p-value that a test relies on goes through
`ledger.require`, which counts it. Each is compared with `LEVEL`, so that N checks raise a false alarm, for a
new choice of seeds, with a probability of at most N x LEVEL; the terminal summary prints both numbers.
"""

from harness.cases import (
    GATE,
    PERIOD_NS,
    WAVE,
    Case,
    case,
    flux_of,
    make_system,
    measured_pulse,
    random_cases,
    shared,
    system_of,
    two_lobes,
    waveform_flux,
)
from harness.check import COUNTS, EVERYTHING, INTERVALS, JOINT, SHAPE, check, compare
from harness.laws import (
    JointLaw,
    Law,
    armed_count_pmf,
    constant_rate_moments,
    first_arrival,
    law_of,
    pmf_of,
    stationary_count_pmf,
)
from harness.ledger import FAMILY_LEVEL, LEVEL, rejected, require
from harness.pvalues import bonferroni, counts_against_law, goodness, mean_vector, same_law, two_mean_vectors
from harness.reference import REFERENCE_NAMES, Reference
from harness.refusal import refused
from harness.sample import Sample, draw, task_of
