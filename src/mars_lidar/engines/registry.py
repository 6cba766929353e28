"""The engines by name, and the alternatives where an engine does not apply."""

from __future__ import annotations  # else Sphinx prints an unpacked type as *EngineOptions

from typing import Unpack

from mars_lidar._base import checks
from mars_lidar.engines.auto import AutoEngine
from mars_lidar.engines.engine import Engine, EngineOptions, given
from mars_lidar.engines.exact import ExactEngine, PoissonEngine, SequentialEngine
from mars_lidar.engines.feedback import FeedbackEngine
from mars_lidar.engines.mars import MarsEngine
from mars_lidar.engines.renewal import RenewalEngine
from mars_lidar.instrument.detector import require_effects, require_mode_of
from mars_lidar.instrument.system import System
from mars_lidar.instrument.tolerances import TOL

ENGINES: dict[str, Engine] = {
    engine.name: engine
    for engine in (
        ExactEngine(),
        FeedbackEngine(),
        AutoEngine(),
        SequentialEngine(),
        MarsEngine(),
        RenewalEngine(),
        PoissonEngine(),
    )
}

ANY_SYSTEM = tuple(name for name, engine in ENGINES.items() if engine.any_system)


def check_detector(engine: Engine, system: System) -> None:
    """Raise ValueError, naming alternatives, if `engine` does not support the detector's mode or effects."""
    if system.cycles > TOL.cycles:
        raise ValueError(f"cycles must be an integer in [1, {TOL.cycles}] to be simulated, got {system.cycles}")
    require_mode_of("engine", engine, ENGINES.values(), system.detector.mode)

    def instead(effect: str) -> str:
        return "; use " + " or ".join(repr(name) for name, each in ENGINES.items() if effect in each.effects)

    require_effects(f"engine {engine.name!r}", system.detector, engine.effects, instead)


def find_engine(engine: str | Engine, **options: Unpack[EngineOptions]) -> Engine:
    """The engine of a name, or the engine itself.

    Parameters
    ----------
    engine
        A name, as for `mars_lidar.simulate`, such as ``"exact"``, ``"auto"`` or ``"mars"``; or an `Engine`.
    options
        `EngineOptions`; None: the default of the engine.

    Returns
    -------
    Engine

    Raises
    ------
    TypeError
        Neither a name nor an `Engine`; an option that this engine does not have.
    ValueError
        An unknown name.

    See Also
    --------
    EngineOptions, mars_lidar.simulate

    Examples
    --------
    >>> from mars_lidar.engines import find_engine
    >>> find_engine("mars", count="gaussian").name
    'mars'
    """
    chosen = given(options)
    if isinstance(engine, Engine):
        if chosen:
            name = next(iter(chosen))
            raise TypeError(f"{name} must be None where engine is an Engine, which has its own, got {chosen[name]!r}")
        return engine
    default = ENGINES[checks.choice("engine", engine, tuple(ENGINES))]
    for name in chosen:
        if name not in default.options:
            takes = ", ".join(default.options) if default.options else "none"
            raise TypeError(f"{name} must be None for engine {engine!r} (its options: {takes}), got {chosen[name]!r}")
    return type(default)(**chosen) if chosen else default
