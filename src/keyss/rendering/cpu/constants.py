"""Constants of all kernels: rendering conventions, and layouts of arrays."""

import numpy as np

from keyss.core.gaussians import DRAWN_OPACITY

f32 = np.float32

# Conventions of 3DGS, as in gsplat's classic mode.
ALPHA_MIN = f32(DRAWN_OPACITY)  # contributions below this are skipped
INVERSE_ALPHA_MIN = f32(1 / DRAWN_OPACITY)
ALPHA_MAX = f32(0.999)  # alpha is clamped to this; no gradient passes a clamped alpha
TRANSMITTANCE_MIN = f32(1e-4)  # a Gaussian that would leave less ends its pixel and is skipped
RADIUS_SIGMAS = f32(3.33)  # maximum reported radii in standard deviations
FOV_MARGIN = f32(0.15)  # the Jacobian is clamped beyond this share of the image on each side
EPS2D = 0.3  # variance added to footprints; with less, the recurrence down the rows would be inexact

# A tile is as wide as a vector, and tall to amortise the recurrence down its rows.
TILE_WIDTH = 8
TILE_HEIGHT = 32
TILE_WIDTH_LOG2 = 3
TILE_HEIGHT_LOG2 = 5
TILE_PIXELS = TILE_WIDTH * TILE_HEIGHT
LAST_ROW_SHIFT = 5  # the rows of a Gaussian in a tile are stored as first | last << this
ENTRY_ROWS_SHIFT = 32  # an entry of a tile's list is Gaussian | rows << this
ENTRY_GAUSSIAN = 2**ENTRY_ROWS_SHIFT - 1  # mask

# The packed record of a Gaussian's footprint: one cache line.
PACKED = 16
X = 0  # centre in pixels
Y = 1
XX = 2  # -sigma = XX dx^2 + XY dx dy + YY dy^2, the exponent of the Gaussian's footprint
XY = 3
YY = 4
LEVEL = 5  # 2 ln(255 opacity): alpha >= 1/255 where 2 sigma <= this
OPACITY = 6
RED = 7
GREEN = 8
BLUE = 9
EXTENT_X = 10  # half the width of the bounding box of all pixels with alpha >= 1/255
EXTENT_Y = 11
DECAY = 12  # exp(2 YY), the ratio of successive ratios down a column

# Sums of the backward pass for a (Gaussian, tile) pair. The moments are one vector: with s = dL/d(-sigma),
# sums of s, s dx, s dy, s dx^2, s dx dy, s dy^2 and of the red and green gradient. Extras are the sum of the
# blue gradient or, with features, of each channel's (red and green stay 0).
MOMENTS = 8

# The camera array: rotation (row-major, 0 to 8), translation, intrinsics and position in the world.
CAMERA = 19
TX = 9
TY = 10
TZ = 11
FX = 12
FY = 13
CX = 14
CY = 15
POSITION = 16

# Tiles per piece of work; neighbouring tiles share cache lines of slots.
TILE_RUN = 8

CHUNK = 2048  # Gaussians per piece of work in the kernels that loop over Gaussians

ZERO = f32(0)
HALF = f32(0.5)
ONE = f32(1)
TWO = f32(2)
HUGE = f32(1e30)  # larger numbers are treated as infinite
# Gaussians with larger colours or depths are skipped: the backward pass multiplies colours by 2^64.
CHANNEL_MAX = f32(1e12)
NORM_MIN = f32(1e-24)  # minimum squared length for normalising
