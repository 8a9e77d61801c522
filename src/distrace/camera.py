"""Pinhole cameras: OpenCV axes (x right, y down, z forward), pixel centres at +0.5, `T_world_camera`."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from distrace.equality import ByValue
from distrace.rays import Rays
from distrace.vectors import length, numbers
from distrace.viewpoint import Number, Point, check_matrices, check_size, orbiting, together, upright


@dataclass(frozen=True, eq=False, repr=False)
class Camera(ByValue):
    """A pinhole camera: intrinsics in pixels, and the pose that maps camera to world.

    Both matrices may have batch axes and may require grad. `orbit`, `look_at` and `from_matrices` make one.
    """

    intrinsics: Float[Tensor, "*batch 3 3"]
    T_world_camera: Float[Tensor, "*batch 4 4"]
    height: int
    width: int

    @staticmethod
    def from_matrices(intrinsics: Tensor, T_world_camera: Tensor, height: int, width: int) -> "Camera":
        """Returns a camera with these matrices. Raises `ValueError` where they are not a camera's.

        >>> intrinsics = torch.tensor([[100.0, 0.0, 16.0], [0.0, 100.0, 16.0], [0.0, 0.0, 1.0]])
        >>> Camera.from_matrices(intrinsics, torch.eye(4), height=32, width=32).rays().shape
        torch.Size([32, 32])
        """
        batch = intrinsics.shape[:-2]
        if intrinsics.shape != (*batch, 3, 3) or T_world_camera.shape != (*batch, 4, 4):
            given = f"{list(intrinsics.shape)} and {list(T_world_camera.shape)}"
            raise ValueError(
                f"matrices of shapes {given} were given; intrinsics are [3, 3] and T_world_camera is [4, 4], after the"
                " same batch axes"
            )
        check_size(height, width)
        check_matrices(intrinsics, T_world_camera)
        return Camera(intrinsics, T_world_camera, height, width)

    @staticmethod
    def look_at(
        eye: Point,
        target: Point,
        *,
        height: int = 512,
        width: int = 512,
        focal_mm: Number = 60.0,
        sensor_mm: float = 32.0,
        focal_px: Number | None = None,
    ) -> "Camera":
        """Returns a camera at `eye` that sees `target` in its middle and y pointing up.

        Points with batch axes give a batch of cameras; tensors that require grad keep their gradients. The focal
        length, a number or a tensor, is in pixels, or in mm together with the sensor's width in mm. Raises
        `ValueError` where the eye is at the target, a length is not positive, or shapes do not fit.
        """
        check_size(height, width)
        given = focal_mm if focal_px is None else focal_px
        focal = given if focal_px is not None else width * given / sensor_mm if sensor_mm > 0 else 0.0
        lengths = torch.as_tensor(focal)
        if not (lengths.isfinite() & (lengths > 0)).all():
            raise ValueError(f"a focal length of {given} on a sensor of {sensor_mm} was given; both must be positive")
        eye, target = together(eye, target)
        forward = target - eye
        if not torch.isfinite(forward).all():
            raise ValueError(f"a camera at {numbers(eye)}, looking at {numbers(target)}, is not finite")
        if not (length(forward) > 0).all():
            raise ValueError(f"the camera at {numbers(eye)} looks at its own place; move the eye or the target")
        pose = torch.eye(4, dtype=eye.dtype, device=eye.device).repeat(*eye.shape[:-1], 1, 1)
        pose[..., :3, :3] = upright(forward / length(forward)[..., None])
        pose[..., :3, 3] = eye
        middle = pose.new_tensor([[1.0, 0.0, width / 2], [0.0, 1.0, height / 2], [0.0, 0.0, 1.0]])
        intrinsics = middle.repeat(*eye.shape[:-1], 1, 1)
        intrinsics[..., 0, 0] = focal
        intrinsics[..., 1, 1] = focal
        return Camera.from_matrices(intrinsics, pose, height, width)

    @staticmethod
    def orbit(
        azimuth: Number,
        elevation: Number,
        distance: Number,
        *,
        height: int = 512,
        width: int = 512,
        focal_mm: Number = 60.0,
        sensor_mm: float = 32.0,
        focal_px: Number | None = None,
        dtype: torch.dtype | None = None,
    ) -> "Camera":
        """Returns a camera that looks at the origin from distance · (sin az · cos el, sin el, cos az · cos el).

        Angles are in degrees. Tensors keep their gradients; tensors `[*batch]` give a batch of cameras. `dtype` is by
        default the tensors', of numbers float32. Raises `ValueError` for values that are not finite, and as `look_at`.

        >>> camera = Camera.orbit(azimuth=torch.tensor([0.0, 90.0]), elevation=0, distance=3)
        >>> camera.T_world_camera.shape
        torch.Size([2, 4, 4])
        """
        eye = orbiting(azimuth, elevation, distance, dtype)
        return Camera.look_at(
            eye,
            torch.zeros_like(eye),
            height=height,
            width=width,
            focal_mm=focal_mm,
            sensor_mm=sensor_mm,
            focal_px=focal_px,
        )

    def pixels(self) -> Float[Tensor, "height width 2"]:
        """Returns the centres (x, y) of all pixels."""
        like = self.intrinsics
        y, x = (torch.arange(0.5, size, dtype=like.dtype, device=like.device) for size in (self.height, self.width))
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)

    def rays(self, pixels: Float[Tensor, "*pixels 2"] | None = None) -> Rays:
        """Returns the rays through pixel positions, by default all centres: [*batch, height, width]."""
        return self.sight(pixels)[0]

    def sight(
        self, pixels: Float[Tensor, "*pixels 2"] | None = None
    ) -> tuple[Rays, Float[Tensor, "*batch_pixels"], Float[Tensor, "*batch_pixels"]]:
        """Returns `rays`, `cosines` and `pixel_angle` at once."""
        pixels = self.pixels() if pixels is None else pixels
        batch = self.intrinsics.shape[:-2]
        axes = (1,) * (pixels.dim() - 1)
        rotation = self.T_world_camera[..., :3, :3].reshape(*batch, *axes, 3, 3)
        ahead = self._ahead(pixels)
        depth_one = length(ahead)
        directions = (rotation * (ahead / depth_one[..., None])[..., None, :]).sum(-1)
        origins = self.T_world_camera[..., :3, 3].reshape(*batch, *axes, 3).expand_as(directions)
        focal = self.intrinsics[..., 0, 0].reshape(*batch, *axes)
        cosines = depth_one.reciprocal()
        return Rays(origins, directions), cosines, cosines.square() / focal

    def project(self, points_world: Float[Tensor, "*points 3"]) -> tuple[Tensor, Tensor]:
        """Returns pixel positions [*points, 2] and depths [*points] of points, for a camera without batch axes."""
        rotation = self.T_world_camera[:3, :3]
        centre = self.T_world_camera[:3, 3]
        points_camera = (points_world - centre) @ rotation
        image = points_camera @ self.intrinsics.T
        return image[..., :2] / image[..., 2:], points_camera[..., 2]

    def shows(self, pixels: Float[Tensor, "*points 2"], depths: Float[Tensor, "*points"]) -> Bool[Tensor, "*points"]:
        """Returns which projections lie within the image, and before the camera."""
        size = pixels.new_tensor([self.width, self.height])
        return (depths > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)

    def nearest_points(
        self, points_world: Float[Tensor, "n 3"]
    ) -> tuple[Int[Tensor, "height width"], Float[Tensor, "height width"]]:
        """Returns the number of the nearest point that falls into each pixel, −1 for none, and its depth or `inf`."""
        positions, depths = self.project(points_world)
        shown = self.shows(positions, depths).nonzero()[:, 0]
        column, row = positions[shown].long().unbind(-1)
        pixel = row * self.width + column
        nearest = depths.new_full((self.height * self.width,), math.inf)
        nearest.scatter_reduce_(0, pixel, depths[shown], "amin")
        number = torch.full_like(nearest, -1, dtype=torch.int64)
        is_nearest = depths[shown] == nearest[pixel]
        number[pixel[is_nearest]] = shown[is_nearest]
        return number.reshape(self.height, self.width), nearest.reshape(self.height, self.width)

    def depth(self, distance: Float[Tensor, "*batch height width"]) -> Float[Tensor, "*batch height width"]:
        """Returns the depth z of points at a distance along each pixel's ray."""
        return distance * self.cosines()

    def cosines(self, pixels: Float[Tensor, "*pixels 2"] | None = None) -> Float[Tensor, "*batch_pixels"]:
        """Returns the cosine between each pixel's ray and the optical axis: depth over distance."""
        return 1 / length(self._ahead(self.pixels() if pixels is None else pixels))

    def pixel_angle(self, pixels: Float[Tensor, "*pixels 2"] | None = None) -> Float[Tensor, "*batch_pixels"]:
        """Returns the width of a pixel at a distance of 1: cos²θ / f, θ from the optical axis, f in pixels."""
        return self.sight(pixels)[2]

    def tolerance(self, least_depth: float) -> Float[Tensor, "*batch height width"]:
        """Returns DIST's convergence criterion: half the distance between neighbouring pixels at the least depth.

        ε = d · cos²θ / (2 f), f in pixels (Liu et al., CVPR 2020, section 3.2).
        """
        return least_depth * self.pixel_angle() / 2

    def resized(self, factor: float) -> "Camera":
        """Returns the same camera with a coarser or finer sensor; sizes are rounded up, so every pixel stays covered.

        Raises `ValueError` for a factor that is not positive.
        """
        if not 0 < factor < math.inf:
            raise ValueError(f"a factor of {factor} was given; a sensor is resized by a positive one")
        scale = self.intrinsics.new_tensor([[factor], [factor], [1.0]])
        height = math.ceil(self.height * factor)
        width = math.ceil(self.width * factor)
        return replace(self, intrinsics=self.intrinsics * scale, height=height, width=width)

    def cropped(self, top: int, left: int, height: int, width: int) -> "Camera":
        """Returns the same camera with a part of its sensor. Raises `ValueError` for a part that it does not have."""
        if not (0 <= top < self.height and 0 <= left < self.width and height > 0 and width > 0):
            size = f"an image of {self.height} × {self.width} pixels"
            raise ValueError(f"{height} × {width} pixels from row {top} and column {left} were given, of {size}")
        intrinsics = self.intrinsics.clone()
        intrinsics[..., 0, 2] -= left
        intrinsics[..., 1, 2] -= top
        height = min(height, self.height - top)
        width = min(width, self.width - left)
        return replace(self, intrinsics=intrinsics, height=height, width=width)

    def bands(self, pixels: int) -> Iterator["Camera"]:
        """Yields the cameras of bands of rows, from the top, each of at most so many pixels, or of one row."""
        rows = max(1, pixels // self.width)
        for top in range(0, self.height, rows):
            yield self.cropped(top, 0, rows, self.width)

    def turned(self, degrees: float) -> "Camera":
        """Returns the camera rotated about the world's y axis, anticlockwise from above."""
        cosine = math.cos(math.radians(degrees))
        sine = math.sin(math.radians(degrees))
        turn = self.T_world_camera.new_tensor([[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 0], [0, 0, 0, 1]])
        return replace(self, T_world_camera=turn @ self.T_world_camera)

    def detach(self) -> "Camera":
        return replace(self, intrinsics=self.intrinsics.detach(), T_world_camera=self.T_world_camera.detach())

    def to(self, device: torch.device | str) -> "Camera":
        return replace(self, intrinsics=self.intrinsics.to(device), T_world_camera=self.T_world_camera.to(device))

    def float(self) -> "Camera":
        """Returns the camera in single precision."""
        return replace(self, intrinsics=self.intrinsics.float(), T_world_camera=self.T_world_camera.float())

    def _ahead(self, pixels: Tensor) -> Float[Tensor, "*batch_pixels 3"]:
        """Returns the points of pixels at depth 1, in the camera's axes."""
        axes = (1,) * (pixels.dim() - 1)
        inverse = self.intrinsics.inverse().reshape(*self.intrinsics.shape[:-2], *axes, 3, 3)
        return (inverse * pad(pixels, (0, 1), value=1.0)[..., None, :]).sum(-1)
