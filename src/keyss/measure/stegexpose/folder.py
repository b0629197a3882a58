"""All images of a folder, and the table of their scores."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from keyss.core.errors import InputError, UsageError
from keyss.fitting.loop import Reporter, SilentReporter
from keyss.measure.stegexpose.scores import DETECTORS, Scores, score_file

THRESHOLD = 0.2  # the original's


@dataclass(frozen=True)
class Row:
    """One image: its file name, its scores, and what they are taken for."""

    file: str
    scores: Scores
    flagged: bool  # fusion above the threshold
    secret_bytes: int  # size of the secret, guessed as fusion x size of the file / 3


@dataclass(frozen=True)
class Steganalysis:
    """The images of a folder by name, and the names of the files that are no readable images."""

    rows: list[Row]
    skipped: list[str]

    @property
    def mean_fusion(self) -> float | None:
        """Over the images that have one."""
        fusions = [fusion for row in self.rows if not math.isnan(fusion := _fusion(row.scores))]
        return sum(fusions) / len(fusions) if fusions else None


def steganalyze(
    folder: Path | str,
    threshold: float = THRESHOLD,
    fast: bool = False,
    reporter: Reporter | None = None,
) -> Steganalysis:
    """Scores of all images in `folder`, not in those below it, sorted by name.

    `fast` stops with an image as soon as it looks clean (see `score_image`). Files that are no readable
    images are skipped and named in the result. Raises InputError when there is no readable image, and
    UsageError for a threshold outside of [0, 1].
    """
    folder = Path(folder)
    if not 0 <= threshold <= 1:
        raise UsageError(f"expected a threshold from 0 to 1, got {threshold:g}")
    paths = _files(folder)
    rows: list[Row] = []
    skipped: list[str] = []
    reporter = reporter or SilentReporter()
    reporter.start(f"steganalyze {folder}", len(paths), 0)
    try:
        for done, path in enumerate(paths, start=1):
            try:
                rows.append(_row(path, threshold, fast))
            except InputError:
                skipped.append(path.name)
            reporter.update(done, 0, {})
    finally:
        reporter.finish()
    if not rows:
        raise InputError(f"{folder}: expected images, but none of its files can be read as one")
    return Steganalysis(rows, skipped)


def csv_bytes(rows: Sequence[Row]) -> bytes:
    """A table in UTF-8: `null` where a detector does not take the image, `NaN` where it finds no solution."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", *DETECTORS, "fusion", "flagged", "secret_bytes"])
    for row in rows:
        scores = asdict(row.scores)
        cells = [_spelled(scores[name]) for name in (*DETECTORS, "fusion")]
        writer.writerow([row.file, *cells, str(row.flagged).lower(), row.secret_bytes])
    return text.getvalue().encode(errors="surrogateescape")  # file names may be any bytes


def _files(folder: Path) -> list[Path]:
    try:
        paths = sorted(path for path in folder.iterdir() if path.is_file())
    except OSError as error:
        raise InputError(f"{folder}: expected a folder of images: {error.strerror}") from error
    if not paths:
        raise InputError(f"{folder}: expected images, but there are no files in it")
    return paths


def _row(path: Path, threshold: float, fast: bool) -> Row:
    scores = score_file(path, stop_below=threshold if fast else None)
    fusion = _fusion(scores)
    guess = 0 if math.isnan(fusion) else math.floor(fusion * path.stat().st_size / 3 + 0.5)
    return Row(path.name, scores, fusion > threshold, guess)


def _fusion(scores: Scores) -> float:
    return math.nan if scores.fusion is None else scores.fusion


def _spelled(score: float | None) -> str:
    if score is None:
        return "null"
    return "NaN" if math.isnan(score) else repr(score)
