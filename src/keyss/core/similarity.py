"""Similarity transforms of the world, applied to points, cameras and Gaussians, and found from cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from keyss.core.gaussians import Gaussians
from keyss.core.scene import Camera, camera_axes, camera_positions, focus_point

_ROTATION_TOLERANCE = 1e-6
# Minimum length of a mean of unit vectors that gives a direction.
_MIN_UP = 0.1
_MIN_HEADING = 0.2


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation @ x + translation, held in float64 on the CPU; by default the identity.

    Raises ValueError if a value is not finite, `scale` is not positive, or `rotation` is not a rotation
    (orthonormal with determinant +1, to 1e-6).
    """

    scale: float = 1.0
    rotation: Tensor = field(default_factory=lambda: torch.eye(3, dtype=torch.float64))  # [3, 3]
    translation: Tensor = field(default_factory=lambda: torch.zeros(3, dtype=torch.float64))  # [3]

    def __post_init__(self) -> None:
        rotation = self.rotation.detach().to("cpu", torch.float64)
        translation = self.translation.detach().to("cpu", torch.float64)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ValueError(
                f"similarity: expected a [3, 3] rotation and a [3] translation, "
                f"got {list(rotation.shape)} and {list(translation.shape)}"
            )
        if not (0 < self.scale < math.inf and translation.isfinite().all()):
            raise ValueError("similarity: expected a positive finite scale and a finite translation")
        off = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
        if not off <= _ROTATION_TOLERANCE or torch.linalg.det(rotation) < 0:  # `off` may be NaN
            raise ValueError("similarity: the rotation is not orthonormal with determinant +1")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    def inverse(self) -> Similarity:
        """The transform that undoes this one."""
        rotation = self.rotation.T
        return Similarity(1.0 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def apply_points(self, points: Tensor) -> Tensor:
        """[..., 3] transformed points, of the dtype and on the device of `points`."""
        rotation, translation = self.rotation.to(points.device), self.translation.to(points.device)
        return (self.scale * (points.double() @ rotation.T) + translation).to(points.dtype)

    def apply_camera(self, camera: Camera) -> Camera:
        """The camera, moved with the world: it takes the same image, at `scale` times the depths."""
        viewmat = camera.viewmat.double()
        moved = viewmat.clone()
        rotation = viewmat[:3, :3] @ self.rotation.T.to(viewmat.device)
        moved[:3, :3] = rotation
        # From scale * (R_c x + t_c) with x = R^T (x' - t) / scale: the camera's own axes keep unit length.
        moved[:3, 3] = self.scale * viewmat[:3, 3] - rotation @ self.translation.to(viewmat.device)
        return replace(camera, viewmat=moved.to(camera.viewmat.dtype), near=self.scale * camera.near)

    def apply_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """The Gaussians, moved with the world, view-dependent colours included.

        Lengths of quaternions and opacities do not change. Differentiable.
        """
        from scipy.spatial.transform import Rotation  # slow to load

        x, y, z, w = Rotation.from_matrix(self.rotation.numpy()).as_quat().tolist()
        # [4, 4]: the Hamilton product of the rotation's quaternion with another, wxyz.
        rows = [[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]
        product = torch.tensor(rows, dtype=torch.float64, device=gaussians.device)
        quats = gaussians.quats.double() @ product.T
        moved = Gaussians(
            means=self.apply_points(gaussians.means),
            quats=quats.to(gaussians.quats.dtype),
            log_scales=gaussians.log_scales + math.log(self.scale),
            opacity_logits=gaussians.opacity_logits,
            sh=_rotate_sh(gaussians.sh, self.rotation),
        )
        return gaussians.like(moved)


def _rotate_sh(sh: Tensor, rotation: Tensor) -> Tensor:
    """[N, K, 3] coefficients of the colour function d -> colour(rotation^T d).

    Each degree spans a space that is closed under rotation: its matrix is the exact solution of basis(d)
    block = basis(rotation^T d) for any directions d. With more directions than unknowns, the system is
    well-conditioned.
    """
    degree = math.isqrt(sh.shape[1]) - 1
    random = torch.Generator().manual_seed(0)
    directions = torch.randn(64, 3, dtype=torch.float64, generator=random)
    directions = torch.nn.functional.normalize(directions, dim=1)
    basis, turned = _sh_basis(directions, degree), _sh_basis(directions @ rotation, degree)
    matrix = torch.eye((degree + 1) ** 2, dtype=torch.float64)
    for band in range(1, degree + 1):
        block = slice(band**2, (band + 1) ** 2)
        matrix[block, block] = torch.linalg.lstsq(basis[:, block], turned[:, block]).solution
    return torch.einsum("ij,njc->nic", matrix.to(sh.device), sh.double()).to(sh.dtype)


def _sh_basis(directions: Tensor, degree: int) -> Tensor:
    """[D, (degree + 1)^2] the real SH basis at [D, 3] unit `directions`; `lpmv` has 3DGS's signs."""
    from scipy.special import factorial, lpmv  # slow to load

    x, y, z = directions.T.numpy()
    longitudes, basis = np.arctan2(y, x), []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            m = abs(order)
            norm = (2 * band + 1) / (4 * np.pi) * factorial(band - m) / factorial(band + m)
            waves = np.sin(m * longitudes) if order < 0 else np.cos(m * longitudes)
            basis.append(np.sqrt(norm * (2 if m else 1)) * lpmv(m, band, z) * waves)
    return torch.from_numpy(np.stack(basis, axis=-1))


def align(secret_cameras: Sequence[Camera], cover_cameras: Sequence[Camera]) -> Similarity:
    """The similarity that moves the secret's world into the cover's frame.

    It maps the secret's focus point to the cover's, and makes the mean distances of the cameras from it and
    the up directions equal. The rotation about the up direction makes the mean headings equal if both
    captures have one (a half ring does, a full ring does not), and is as small as possible otherwise. Without
    an up direction, the rotation is the identity.

    Raises ValueError when either set is empty.
    """
    secret, cover = _Capture.of(secret_cameras), _Capture.of(cover_cameras)
    scale = cover.distance / secret.distance
    rotation = _rotation(secret, cover)
    return Similarity(scale, rotation, cover.focus - scale * rotation @ secret.focus)


def up_direction(cameras: Sequence[Camera]) -> Tensor | None:
    """[3] float64 unit up direction of the world, None if the cameras do not agree on one.

    People hold cameras level but tilt them: the horizontal axes of the images span the horizontal plane of
    the world, while the mean of the cameras' up vectors leans forward by up to 20 degrees on a half ring.
    That mean is used only if the horizontal axes do not span a plane.
    """
    mean = camera_axes(cameras, 1).mean(0).neg()
    if float(mean.norm()) < _MIN_UP:
        return None
    right = camera_axes(cameras, 0)
    spread, axes = torch.linalg.eigh(right.T @ right / len(cameras))
    normal: Tensor = axes[:, 0] * torch.sign(axes[:, 0] @ mean)
    planar = bool(spread[1] > 0.05 and spread[0] < 0.2 * spread[1])
    if planar and float(normal @ mean) > 0.5 * float(mean.norm()):
        return normal
    return torch.nn.functional.normalize(mean, dim=0)


@dataclass(frozen=True)
class _Capture:
    """Focus and directions of a set of cameras, all float64."""

    focus: Tensor  # [3]
    distance: float  # mean from the cameras to the focus, positive
    up: Tensor | None  # [3] unit vector
    heading: Tensor | None  # [3] unit vector, mean viewing direction across `up`

    @staticmethod
    def of(cameras: Sequence[Camera]) -> _Capture:
        focus = focus_point(cameras)
        distance = float((camera_positions(cameras).double() - focus).norm(dim=1).mean())
        up = up_direction(cameras)
        heading = None
        if up is not None:
            forward = camera_axes(cameras, 2).mean(0)
            across = forward - up * (up @ forward)
            if float(across.norm()) > _MIN_HEADING:
                heading = torch.nn.functional.normalize(across, dim=0)
        return _Capture(focus, distance if distance > 0 else 1.0, up, heading)


def _rotation(secret: _Capture, cover: _Capture) -> Tensor:
    """[3, 3] float64 rotation that maps the secret's up direction to the cover's, and then aligns headings.

    The smallest such rotation if a capture has no heading; the identity if it has no up direction.
    """
    if secret.up is None or cover.up is None:
        return torch.eye(3, dtype=torch.float64)
    from scipy.spatial.transform import Rotation  # slow to load

    if secret.heading is None or cover.heading is None:
        rotation, _ = Rotation.align_vectors(cover.up[None], secret.up[None])
    else:
        targets, sources = torch.stack([cover.up, cover.heading]), torch.stack([secret.up, secret.heading])
        rotation, _ = Rotation.align_vectors(targets, sources, weights=[math.inf, 1])
    return torch.from_numpy(rotation.as_matrix())
