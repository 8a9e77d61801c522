"""Scans on disk."""

from pathlib import Path

import pytest

import distrace as dt
from distrace.camera import Camera
from distrace.data.observation import View
from distrace.data.saved_scan import read_scan, save_scan
from distrace.data.scan import canonical_scan
from distrace.fields import primitives

CAMERA = Camera.orbit(30, 20, 4.97, height=48, width=64)


def test_a_scan_is_read_back(tmp_path: Path) -> None:
    sphere = dt.render(primitives.sphere(0.5), CAMERA)
    scan = canonical_scan(View(CAMERA, sphere.depth, sphere.mask))
    save_scan(tmp_path / "scan.npz", scan)
    again, (camera,) = read_scan(tmp_path / "scan.npz")
    assert again.points.equal(scan.points)
    assert again.free_until.equal(scan.free_until)
    assert again.noise == pytest.approx(scan.noise)
    assert camera.T_world_camera.equal(CAMERA.T_world_camera)
    assert (camera.height, camera.width) == (48, 64)
    (tmp_path / "wrong.npz").write_bytes(b"no archive")
    with pytest.raises(ValueError, match="no scan"):
        read_scan(tmp_path / "wrong.npz")
