"""Two samples, one question: can a classifier that has seen half of each tell the other halves apart?

The only part of the package that uses scikit-learn (extra ``studies``), imported when it is first needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import rankdata

from mars_lidar._base.imports import needed
from mars_lidar._base.types import FloatArray

QDA, BOOSTING, FOREST = "QDA", "gradient boosting", "random forest"
CLASSIFIERS = (QDA, BOOSTING, FOREST)
REGULARISATION = 1e-4  # of QDA's covariances, of standardised features: makes collinear ones harmless
TREES, LEAF = 100, 5
_JOBS = 2  # of the random forest


def require_sklearn() -> str:
    """Version of scikit-learn; raises MissingLibraryError where it cannot be imported."""
    return str(needed("sklearn", "study 'joint'", "studies").__version__)


def separate(kind: str, first: FloatArray, second: FloatArray, seed: int) -> tuple[float, float]:
    """AUC by which a classifier separates two samples (n, k) and (m, k), and its standard error.

    Trained on the first half of each, judged on the second; 1/2 is chance.
    """
    half = len(first) // 2, len(second) // 2
    train = np.concatenate([first[: half[0]], second[: half[1]]])
    require_sklearn()
    varies = np.ptp(train, axis=0) > 0
    if not varies.any():
        return 0.5, 0.0
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    model = _model(kind, seed)
    with threadpool_limits(1):  # threads that wait for each other on a busy machine cost ten times the work
        model.fit(train[:, varies], np.repeat([0, 1], half))
        scores = [_score(model, x[h:, varies]) for x, h in zip((first, second), half, strict=True)]
    return auc(*scores)


def auc(low: FloatArray, high: FloatArray) -> tuple[float, float]:
    """Probability that a score of `high` (m,) exceeds one of `low` (n,), ties by half; standard error.

    The error is that of DeLong, DeLong and Clarke-Pearson (Biometrics 44, 1988), from the placements of each
    score among those of the other sample.
    """
    n, m = low.size, high.size
    ranks = rankdata(np.concatenate([low, high]))
    above = 1.0 - (ranks[:n] - rankdata(low)) / m
    below = (ranks[n:] - rankdata(high)) / n
    return float(below.mean()), float(np.sqrt(above.var(ddof=1) / n + below.var(ddof=1) / m))


def chance_error(n: int, m: int) -> float:
    """Standard error of the AUC of two samples of one continuous law (Mann and Whitney, 1947)."""
    return float(np.sqrt((n + m + 1) / (12.0 * n * m)))


def chance(exposures: int) -> float:
    """Standard error of the AUC of two samples of one law, half of the `exposures` of each held out."""
    return chance_error(exposures - exposures // 2, exposures - exposures // 2)


def _model(kind: str, seed: int) -> Any:
    if kind == QDA:
        from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        # tol only decides about warnings: the total is the sum of the bins, on purpose
        return make_pipeline(StandardScaler(), QuadraticDiscriminantAnalysis(reg_param=REGULARISATION, tol=0.0))
    if kind == BOOSTING:
        from sklearn.ensemble import HistGradientBoostingClassifier

        return HistGradientBoostingClassifier(early_stopping=False, random_state=seed)
    if kind == FOREST:
        from sklearn.ensemble import RandomForestClassifier

        return RandomForestClassifier(TREES, min_samples_leaf=LEAF, n_jobs=_JOBS, random_state=seed)
    raise ValueError(f"kind must be one of {CLASSIFIERS}, got {kind!r}")


def _score(model: Any, x: FloatArray) -> FloatArray:
    """Any increasing function of the odds: the decision function, without one the probability."""
    if hasattr(model, "decision_function"):
        return np.asarray(model.decision_function(x), dtype=np.float64)
    return np.asarray(model.predict_proba(x)[:, 1], dtype=np.float64)
