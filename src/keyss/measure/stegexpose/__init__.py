"""StegExpose (2014): four detectors of LSB replacement in 8-bit images, and their mean.

Written anew from a description of what the original program computes; it gives the original's scores,
quirks included. For any renderer's output an AUC near 0.5 is to be expected: nothing there replaces the
last bits of pixels.
"""

from keyss.measure.stegexpose.decoding import read_pixels
from keyss.measure.stegexpose.folder import THRESHOLD, Row, Steganalysis, csv_bytes, steganalyze
from keyss.measure.stegexpose.scores import DETECTORS, Scores, score_file, score_image

__all__ = [
    "DETECTORS",
    "THRESHOLD",
    "Row",
    "Scores",
    "Steganalysis",
    "csv_bytes",
    "read_pixels",
    "score_file",
    "score_image",
    "steganalyze",
]
