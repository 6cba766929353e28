"""Package version, the same as in pyproject.toml (a test compares them)."""

__version__ = "0.3.0"


def other_version(made_by: object) -> str:
    """Suffix of a message on differing counts: empty, or a note that another version simulated them."""
    if made_by in (None, "", __version__):
        return ""
    versions = f"made by mars-lidar {made_by}, this is {__version__}"
    return f" ({versions}: another version may draw other counts of the same law; {made_by} makes these again)"
