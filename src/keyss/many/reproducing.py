"""`reproduce`: a table of the paper, run again on its scenes or others, and shown beside its figures."""

from __future__ import annotations

import os
import re
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from itertools import product
from pathlib import Path
from statistics import fmean
from typing import Any

from keyss.core.errors import InputError, OutputError, UsageError, did_you_mean, import_extra
from keyss.core.scene import ViewOptions
from keyss.files.atomic import write_bytes
from keyss.files.colmap import MODEL_PLACES, colmap_model_folder, read_colmap
from keyss.many.cell import result_of
from keyss.many.changes import with_changes
from keyss.many.paper import PAPER, Group, Reproduction, Run, figure_rows, judged, reproduction_text
from keyss.many.running import CellFolder, Forecast
from keyss.methods import registry
from keyss.methods.base import MethodOptions
from keyss.progress import Reporter, reporter as default_reporter
from keyss.rendering import Backend
from keyss.rendering.orbit import is_model
from keyss.runs.files import PathLike
from keyss.runs.records import write_record

TEST_EVERY = 8

# Number of photos, and the folder that the paper uses: a quarter of the size outdoors, half of it indoors.
BENCHMARK: Mapping[str, tuple[int, str]] = {
    "bicycle": (194, "images_4"),
    "bonsai": (292, "images_2"),
    "room": (311, "images_2"),
    "flowers": (173, "images_4"),
    "treehill": (141, "images_4"),
    "garden": (185, "images_4"),
    "stump": (125, "images_4"),
    "counter": (240, "images_2"),
    "kitchen": (279, "images_2"),
    "playroom": (225, "images"),
}
_REFRAW = "https://storage.googleapis.com/gresearch/refraw360"
_INRIA = "https://repo-sam.inria.fr/fungraph/3d-gaussian-splatting/datasets/input"
# Archives, and the folder of each scene in them: Mip-NeRF 360 from its authors, and Deep Blending from those
# of 3DGS. No checksums are published.
SOURCES: Mapping[str, tuple[str, ...]] = {
    f"{_REFRAW}/360_v2.zip": ("bicycle", "bonsai", "counter", "garden", "kitchen", "room", "stump"),
    f"{_REFRAW}/360_extra_scenes.zip": ("flowers", "treehill"),
    f"{_INRIA}/tandt_db.zip": ("db/playroom",),
}
SMALL = {"iterations": 1000, "max_gaussians": 9000, "width": 120}
SSIM_WEIGHT = 0.5  # of the loss, for plain models too


def download_scenes(names: Iterable[str], data: Path) -> None:
    """Download those of the scenes that are missing in `data`, with the photos that the paper uses.

    Archives stay in `data/archives`. Raises InputError for a failed download or a damaged archive, and
    BackendError without pooch.
    """
    pooch = import_extra("pooch", "reproduce", "download scenes")
    missing = {name for name in names if not (data / name).exists()}
    archives = data / "archives"
    for url, folders in SOURCES.items():
        wanted = {name: folder for folder in folders if (name := folder.rpartition("/")[2]) in missing}
        parts = {name: ("sparse/0", BENCHMARK[name][1]) for name in wanted}
        members = [f"{folder}/{part}" for name, folder in wanted.items() for part in parts[name]]
        file = url.rpartition("/")[2]
        if not wanted:
            continue
        try:
            unzip = pooch.Unzip(members, extract_dir="unpacked")
            pooch.retrieve(url, None, file, path=archives, processor=unzip, progressbar=True)
            for name, folder in wanted.items():
                (archives / "unpacked" / folder).rename(data / name)
        except (OSError, ValueError, zipfile.BadZipFile, zlib.error) as error:
            advice = f"if {archives / file} exists, remove it to download it again"
            raise InputError(f"{url}: cannot be downloaded or unpacked: {error}; {advice}") from error


def link_scene(data: Path, name: str, folder: Path) -> Path:
    """A scene of the paper in `folder`, with links to the photos that the paper uses.

    Raises InputError where they are missing, or not as many as the paper's; OutputError.
    """
    (photos, images), scene, source = BENCHMARK[name], folder / name, data / name
    model = next((place for place in MODEL_PLACES if colmap_model_folder(source, (place,))), None)
    if model is None or not (source / images).is_dir():
        raise InputError(
            f"{data}: expected a folder {name} with {images} and a COLMAP model, a scene of Mip-NeRF 360 (or "
            "playroom, of Deep Blending), found none; `download=True` downloads it"
        )
    try:
        scene.mkdir(parents=True, exist_ok=True)
        for place, target in (("sparse", source / model), (images, source / images)):
            if not (scene / place).is_symlink():
                (scene / place).symlink_to(target.resolve())
    except OSError as error:
        raise OutputError(f"cannot write to {scene}: {error.strerror}") from error
    layout = read_colmap(scene)
    counted = len(layout.train) + len(layout.test), len(layout.test)
    if counted != (photos, -(-photos // TEST_EVERY)):
        raise InputError(
            f"{source}: expected {photos} photos in the COLMAP model, every {TEST_EVERY}th for testing, "
            f"found {counted[0]}, {counted[1]} for testing"
        )
    return scene


def reproduce(
    table: str,
    scenes: Sequence[PathLike] = (),
    *,
    data: PathLike | None = None,
    download: bool = False,
    pairs: Sequence[str] = (),
    iterations: int | None = None,
    max_gaussians: int | None = None,
    width: int | None = None,
    seed: int = 0,
    device: Backend = "auto",
    out: PathLike,
    dry_run: bool = False,
    reporter: Reporter | None = None,
) -> Reproduction | Forecast:
    """Reproduce a table of the paper, one of `keyss.many.paper.PAPER.tables`.

    The `scenes` (folders of photos) hide each other, with 1,000 steps, 9,000 Gaussians and 120 pixels of
    width unless others are given. With `data` they are the paper's in that folder, Mip-NeRF 360 and playroom
    of Deep Blending, with its 30,000 steps and 500,000 Gaussians; `download` fetches those that are missing.
    `pairs`: which hide which, as "COVER,SECRET" or "COVER,SECRET,SECRET" by the names of their folders; by
    default each hides the next, and the paper's as published.

    `out` (a folder) gets `TABLE.json` and `TABLE.md`, and the cells, which tables in one folder share. Cells
    that are done are skipped. `dry_run`: only return their plans. The result lists runs that failed.
    Raises KeyssError and its children for impossible scenes and arguments; Interrupted.
    """
    if table not in PAPER.tables:
        raise UsageError(f"no table is called {table!r}; {did_you_mean(table, PAPER.tables)}")
    if width is not None and width < 1:
        raise UsageError(f"`width`: expected at least 1, got {width}")
    spec = PAPER.tables[table]
    paths = _paths(scenes) if data is None else dict.fromkeys(BENCHMARK, "")
    if data is not None and scenes:
        raise UsageError("`data` takes the paper's scenes: leave out the others")
    default = spec.groups if data is not None else None
    groups = groups_of(list(paths), spec.secrets, pairs, default)
    given = {"iterations": iterations, "max_gaussians": max_gaussians, "width": width}
    small = SMALL if data is None else {}
    sizes = {name: small.get(name) if value is None else value for name, value in given.items()}
    fit = {"iterations": sizes["iterations"], "max_gaussians": sizes["max_gaussians"]}
    changes: dict[str, Any] = {name: value for name, value in fit.items() if value is not None}
    changes |= {"seed": seed, "ssim_weight": SSIM_WEIGHT}
    options = {name: _options(run).with_fit(**changes) for name, run in spec.runs.items()}
    folder = CellFolder(Path(out), common={"views": ViewOptions(sizes["width"]), "device": device})
    with tempfile.TemporaryDirectory() as temporary:
        if data is not None:
            names = sorted({name for group in groups for name in group})
            if download:
                download_scenes(names, Path(data))
            links = Path(os.path.realpath(temporary)) if dry_run else folder.out.absolute() / "scenes"
            paths = {name: str(link_scene(Path(data), name, links)) for name in names}
        places: dict[Path, str] = {}
        for group, (name, run) in product(groups, spec.runs.items()):
            sources = [paths[scene] for scene in group[: run.secrets + 1]]
            models = [folder.plain(source, options[name].fit) for source in sources]
            title = f"{name}, {'-'.join(group)}"
            places[folder.hiding(title, sources, options[name], models, measures=spec.measures)] = name
        if dry_run:
            return folder.forecast()
        outcomes = folder.run(f"table {table}", reporter=reporter or default_reporter())
    numbers: dict[str, list[dict[str, float]]] = {name: [] for name in spec.runs}
    for place, name in places.items():
        if (result := result_of(place, spec.measures)) is not None:
            numbers[name].append(_numbers(result.numbers))
    covers = [] if data is None else [cover for cover, *_ in groups]
    rows = figure_rows(spec, numbers, len(groups), covers)
    measured = {row.label: row.here for row in rows}
    reproduction = Reproduction(
        table=table,
        title=spec.title,
        arguments={**sizes, "seed": seed},
        pairs=tuple("-".join(group) for group in groups),
        rows=rows,
        claims=tuple(judged(claim, measured) for claim in spec.claims),
        failures={each.name: each.error for each in outcomes.values() if each.error},
    )
    write_record(folder.out / f"{table}.json", reproduction)
    write_bytes(folder.out / f"{table}.md", reproduction_text(reproduction).encode())
    return reproduction


def _options(run: Run) -> MethodOptions:
    """The paper's settings, except the changes of the run."""
    preset = registry.get(run.method).options.preset("full")
    design = {"design": "published"} if run.method == "keyss" else {}
    return with_changes(preset, {**design, **run.changes})


def _paths(scenes: Sequence[PathLike]) -> dict[str, str]:
    """Folders of scenes, by name. Raises UsageError."""
    if any(map(is_model, scenes)):
        raise UsageError("expected scenes, folders of photos: models have none to compare with")
    paths: dict[str, str] = {}
    for path in map(os.path.realpath, scenes):
        name = os.path.basename(path)
        if paths.setdefault(name, path) != path:
            raise UsageError(f"expected scenes of different names, got two that are called {name}")
    return paths


def groups_of(
    names: Sequence[str], secrets: int, pairs: Sequence[str], default: Sequence[Group] | None
) -> Sequence[Group]:
    """Which scenes hide which; by default each hides the next ones, the last ones the first again.

    `pairs`: COVER,SECRET or COVER,SECRET,SECRET. Raises UsageError.
    """
    groups = [tuple(name.strip() for name in text.split(",")) for text in pairs]
    for text, group in zip(pairs, groups, strict=True):
        if len(group) != secrets + 1 or len(set(group)) < len(group):
            raise UsageError(
                f"`pairs`: expected a cover and {secrets} secret(s) of different names, got {text!r}"
            )
        for name in group:
            if name not in names:
                raise UsageError(f"`pairs`: no scene is called {name!r}; {did_you_mean(name, names)}")
    if groups or default:
        return groups or default or ()
    if len(names) <= secrets:
        raise UsageError(f"expected at least {secrets + 1} scenes, got {len(names)}")
    twice = [*names, *names]
    return [tuple(twice[index : index + secrets + 1]) for index in range(len(names))]


def _numbers(numbers: Mapping[str, float]) -> dict[str, float]:
    """The numbers of a cell, by the names of the paper's figures."""
    measures = ("pruning.", "rendering.", "sinkhorn.")  # whose numbers have the paper's names
    figures = {name.partition(".")[2]: value for name, value in numbers.items() if name.startswith(measures)}
    secrets = [value for name, value in numbers.items() if re.fullmatch(r"secrets\.\d+\.psnr", name)]
    figures |= {f"secret {number}": psnr for number, psnr in enumerate(secrets, start=1)}
    cover, secret = numbers["cover.psnr"], fmean(secrets)
    figures |= {"cover": cover, "secret": secret, "mean of both": (cover + secret) / 2}
    # Through the decoder of the first secret.
    wrong = {"cover": "wrong_key.vs_cover.mean", "secret": "wrong_key.vs_secrets.1.mean"}
    return figures | {f"wrong key, {role}": numbers[name] for role, name in wrong.items() if name in numbers}
