"""All scenes in a folder: by a manifest, a pattern, or the layouts of data sets; unusable files are listed."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import check_claim, reading
from mars_lidar._base.progress import callback_of
from mars_lidar._base.types import Progress
from mars_lidar.io import rgbd
from mars_lidar.scene.scene import Scene

BAD_FILE = (ValueError, TypeError, OSError, MemoryError)  # what a scene that cannot be used raises
MANIFEST = "manifest.csv"
_COLUMNS = ("depth", "image", "index", "depth_unit_m", "focal_px", "max_depth_m")
_DEPTH = (".png", ".tif", ".tiff", ".npy", ".pfm", ".exr")
_ALONE = (".npz", ".pfm", ".exr")  # depth whatever their name
_IMAGE = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff", ".ppm", ".npy")
_DEPTH_FOLDERS = ("depth", "depths")
_IMAGE_WORDS = ("rgb", "colors", "color", "colours", "colour", "image", "images", "img")


@dataclass(frozen=True, kw_only=True)
class SceneFile:
    """Location of a scene; `load` reads it. The arguments are those of `mars_lidar.Scene.from_rgbd`.

    Parameters
    ----------
    depth
        File or folder of the depth.
    image
        Image whose luminance is the reflectivity; None: the reflectivity is 1.
    index
        Frame of a file with several.
    depth_unit_m
        Metres per stored unit.
    focal_px
        Focal length, pixels: turns depth along the axis into range along the ray.
    max_depth_m
        Depths beyond this are treated as no return, m.

    Raises
    ------
    ValueError, TypeError
        By `load`: a file that is missing, damaged or of the wrong kind; the message names it.

    See Also
    --------
    scan, mars_lidar.Scene.from_rgbd

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import numpy as np
    >>> from mars_lidar import io
    >>> np.save(folder / "depth.npy", np.full((32, 48), 3.0))
    >>> scene = io.SceneFile(depth=folder / "depth.npy").load()
    >>> scene.shape
    (32, 48)
    """

    depth: Path
    image: Path | None = None
    index: int | None = None
    depth_unit_m: float | None = None
    focal_px: float | None = None
    max_depth_m: float | None = None

    def load(self, *, size: int | tuple[int, int] | None = None) -> Scene:
        """Read the scene, at `size` as in `mars_lidar.Scene.resize`."""
        arguments = {field.name: getattr(self, field.name) for field in fields(self)}
        return Scene.from_rgbd(arguments.pop("depth"), arguments.pop("image"), size=size, **arguments)


@dataclass(frozen=True)
class Problem:
    """A file that cannot be used, and the reason.

    Attributes
    ----------
    path
        The file.
    reason
        The reason, one sentence.

    See Also
    --------
    scan

    Examples
    --------
    >>> import pathlib
    >>> from mars_lidar import io
    >>> io.Problem(pathlib.Path("depth.png"), "it is empty").reason
    'it is empty'
    """

    path: Path
    reason: str

    @classmethod
    def of(cls, path: Path, error: Exception) -> Problem:
        """The file at `path` with the message of an `error`."""
        return cls(path, " ".join(str(error).split()) or type(error).__name__)

    def __str__(self) -> str:
        return self.reason if self.reason.startswith(str(self.path)) else f"{self.path}: {self.reason}"


@checked
def scan(
    folder: str | Path,
    *,
    pattern: str | None = None,
    image: tuple[str, str] | None = None,
    manifest: str | Path | None = None,
    depth_unit_m: float | None = None,
    focal_px: float | None = None,
    max_depth_m: float | None = None,
    check: bool = True,
    progress: Progress | bool | None = None,
) -> tuple[list[SceneFile], list[Problem]]:
    """Find the scenes in a folder and in the folders below it.

    Scenes are recognised in this order:

    - `manifest`, or a ``manifest.csv`` in the folder: a CSV with a header; columns ``depth``, and optionally
      ``image``, ``index``, ``depth_unit_m``, ``focal_px``, ``max_depth_m``; paths are relative to the manifest. Empty
      fields are not given.
    - `pattern`: every depth file or folder that it matches (``"**/*_depth.png"``); its image is the file whose
      path, relative to `folder`, has the second text of `image` in place of the first
      (``("_depth.png", "_colors.png")``).
    - otherwise: Middlebury folders; NYUv2's labelled ``.mat``, every frame; ``.npz``, ``.pfm`` and ``.exr``
      files; and depth images or ``.npy`` whose name ends in ``depth`` (``0001_depth.png``) or that lie in a
      folder ``depth``. The image is the file of the same name (.png, .jpg, .webp, ...) without ``depth``, or with
      ``rgb``, ``color``, ``colors``, ``image`` or ``img`` in place of it, in the name or in the folder's; without one,
      reflectivity is 1; a folder without any image raises a warning.

    Parameters
    ----------
    folder
        Folder to search.
    pattern, image, manifest
        Rules for scenes, as above.
    depth_unit_m, focal_px, max_depth_m
        As for `mars_lidar.Scene.from_rgbd`, for all scenes; values of a manifest take precedence.
    check
        Read every scene once, so that damaged files are reported now and not during a long run.
    progress
        Called as ``progress(done, total)``; True: a bar.

    Returns
    -------
    scenes, problems
        `SceneFile` in the order of their paths, and the omitted files with the reasons.

    Raises
    ------
    ValueError, TypeError
        A folder or manifest that does not exist, a manifest without a column ``depth``, or a bad argument.

    See Also
    --------
    SceneFile, mars_lidar.generate

    Examples
    --------
    >>> import pathlib, tempfile
    >>> folder = pathlib.Path(tempfile.mkdtemp())
    >>> import numpy as np
    >>> from mars_lidar import io
    >>> from PIL import Image
    >>> np.save(folder / "0001_depth.npy", np.full((32, 48), 3.0))
    >>> Image.new("L", (48, 32), 128).save(folder / "0001.png")
    >>> scenes, problems = io.scan(folder)
    >>> [scene.depth.name for scene in scenes], problems
    (['0001_depth.npy'], [])
    """
    for name, value in (("depth_unit_m", depth_unit_m), ("focal_px", focal_px), ("max_depth_m", max_depth_m)):
        if value is not None:
            checks.real(name, value, low=0.0, strict_low=True)
    root = Path(folder)
    if not root.is_dir():
        raise ValueError(f"{root}: no such folder")
    if image is not None and (pattern is None or len(image) != 2):
        raise ValueError(f"image must be two texts that go with a pattern, got {image!r}")
    if pattern is not None and manifest is not None:
        raise ValueError("scenes come from a pattern or from a manifest, got both")
    progress = callback_of(progress, "reading")
    problems: list[Problem] = []
    if manifest is None and pattern is None and (root / MANIFEST).is_file():
        manifest = root / MANIFEST
    if manifest is not None:
        shared = {"depth_unit_m": depth_unit_m, "focal_px": focal_px, "max_depth_m": max_depth_m}
        listed = _listed(Path(manifest), shared, problems)
    elif pattern is not None:
        listed = _matching(root, pattern, image, problems)
    else:
        listed = _recognised(root, problems)
    candidates = list(listed)
    if manifest is None:
        _warn_without_images(root, candidates)
        for k, scene in enumerate(candidates):
            own_unit = scene.depth.is_dir() or scene.depth.suffix.lower() == ".mat"  # these are in metres
            unit = None if own_unit else depth_unit_m
            candidates[k] = replace(scene, depth_unit_m=unit, focal_px=focal_px, max_depth_m=max_depth_m)
    if not check:
        return candidates, problems
    scenes = []
    for k, scene in enumerate(candidates):
        try:
            scene.load()
        except BAD_FILE as error:
            problems.append(Problem.of(scene.depth, error))
        else:
            scenes.append(scene)
        if progress is not None:
            progress(k + 1, len(candidates))
    return scenes, problems


def _listed(path: Path, shared: dict[str, float | None], problems: list[Problem]) -> Iterator[SceneFile]:
    if not path.exists():
        raise ValueError(f"{path}: no such file")
    with reading(path, "CSV"), open(path, newline="", encoding="utf-8-sig") as lines:
        check_claim(path, 64 * path.stat().st_size, "its rows")
        reader = csv.DictReader(lines)
        names = list(reader.fieldnames or ())
        rows = list(reader)
    unknown = [name for name in names if name not in _COLUMNS]
    if "depth" not in names or unknown:
        raise ValueError(f"{path}: columns must be depth and any of {', '.join(_COLUMNS[1:])}, got {', '.join(names)}")
    for number, row in enumerate(rows, start=2):
        try:
            if not row["depth"] or None in row:
                raise ValueError("must give depth, and no more than the columns of the header")
            yield SceneFile(
                depth=path.parent / row["depth"],
                image=path.parent / row["image"] if row.get("image") else None,
                index=int(row["index"]) if row.get("index") else None,
                **{name: float(row[name]) if row.get(name) else of_all for name, of_all in shared.items()},
            )
        except ValueError as error:
            problems.append(Problem(path, f"line {number}: {error}"))


def _matching(root: Path, pattern: str, image: tuple[str, str] | None, problems: list[Problem]) -> Iterator[SceneFile]:
    for path in sorted(root.glob(pattern)):
        other = None if image is None else root / path.relative_to(root).as_posix().replace(*image)
        if other is not None and (other == path or not other.is_file()):
            problems.append(Problem(path, f"its image {other} is missing"))
        else:
            yield from _frames(path, other, problems)


def _recognised(root: Path, problems: list[Problem]) -> Iterator[SceneFile]:
    if rgbd.is_middlebury(root):
        yield SceneFile(depth=root)
        return
    try:
        inside = sorted(root.iterdir())
    except OSError as error:
        problems.append(Problem(root, f"cannot be opened ({error})"))
        return
    for path in inside:
        suffix = path.suffix.lower()
        if path.is_dir():
            yield from _recognised(path, problems)
        elif suffix == ".mat":
            yield from _frames(path, None, problems)
        elif suffix in _ALONE or (suffix in _DEPTH and _is_depth(path)):
            yield SceneFile(depth=path, image=None if suffix == ".npz" else _partner(path))


def _frames(path: Path, image: Path | None, problems: list[Problem]) -> Iterator[SceneFile]:
    """The file, or each frame of an NYUv2 .mat."""
    if path.suffix.lower() != ".mat":
        yield SceneFile(depth=path, image=image)
        return
    try:
        if not rgbd.is_nyu(path):
            yield SceneFile(depth=path, image=image)
            return
        count = rgbd.nyu_frames(path)
    except BAD_FILE as error:
        problems.append(Problem.of(path, error))
        return
    for k in range(count):
        yield SceneFile(depth=path, image=image, index=k)


def _is_depth(path: Path) -> bool:
    stem = path.stem.lower()
    return stem.startswith("depth") or stem.endswith("depth") or path.parent.name.lower() in _DEPTH_FOLDERS


def _partner(path: Path) -> Path | None:
    """The image that belongs to a depth file by its name."""
    stems = []
    if path.stem.lower().endswith("depth"):
        stems += [path.with_name(path.stem[:-5] + word) for word in _IMAGE_WORDS]
        if bare := path.stem[:-5].rstrip("_-. "):
            stems.append(path.with_name(bare))  # 0001_depth.png and 0001.jpg
    elif path.stem.lower().startswith("depth"):
        stems += [path.with_name(word + path.stem[5:]) for word in _IMAGE_WORDS]
        if bare := path.stem[5:].lstrip("_-. "):
            stems.append(path.with_name(bare))  # depth_0001.png and 0001.jpg
    elif path.suffix.lower() in _ALONE:
        stems.append(path.with_suffix(""))
    if path.parent.name.lower() in _DEPTH_FOLDERS:
        above = path.parent.parent
        for stem in [path.stem, *(base.name for base in stems)]:
            stems += [above / word / stem for word in _IMAGE_WORDS]
    for base in stems:
        for suffix in (*_IMAGE, *map(str.upper, _IMAGE)):
            image = base.with_name(base.name + suffix)
            if image.is_file() and image != path:
                return image
    return None


def _warn_without_images(root: Path, scenes: list[SceneFile]) -> None:
    """Warn where no scene of a folder has an image: reflectivity is then the same everywhere, which few want."""
    alone = [scene for scene in scenes if scene.image is None and scene.depth.suffix.lower() in _DEPTH]
    if alone and len(alone) == len(scenes):
        warnings.warn(
            f"{root}: no image was found to any of {len(scenes)} depth files, so that reflectivity is 1 everywhere; "
            f"{alone[0].depth.name} takes one of the same name without 'depth', or with 'rgb', 'color' or 'image' in "
            "place of it; or name the files by pattern and image (--pattern, --image)",
            UserWarning,
            stacklevel=4,  # of `scan`, through what checks its arguments
        )
