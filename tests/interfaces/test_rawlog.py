"""Logs of laser scans: made by hand, and those that Debian installs."""

import gzip
import struct

import numpy as np
import pytest

from jaxsense.interfaces import rawlog

POSES = {
    1: b"\x87CPose3D\x01\x88CMatrixD\x00" + struct.pack("<II16d", 4, 4, *range(16)) + b"\x88\x88",
    2: b"\x87CPose3D\x02" + struct.pack("<7d", 0.78, 0, 0.3, 1, 0, 0, 0) + b"\x88",
}


def scan(ranges, valid, *, version=6, pose=2, from_right=True, aperture=np.pi):
    head = b"\x97CObservation2DRangeScan" + bytes([version])
    fields = struct.pack("<f?f", aperture, from_right, 80.0)
    content = np.array(ranges, "<f4").tobytes() + np.array(valid, "u1").tobytes()
    return head + fields + POSES.get(pose, pose) + struct.pack("<I", len(ranges)) + content


@pytest.fixture
def log(tmp_path):
    """Writes scans between other objects, compressed as often as asked."""

    def write(*scans, times=1):
        content = b"\x8dCSensoryFrame\x02" + b"\x88\x88\x91other\x00".join(scans)
        for _ in range(times):
            content = gzip.compress(content)
        (tmp_path / "log").write_bytes(content)
        return tmp_path / "log"

    return write


@pytest.mark.parametrize("times", [0, 1, 2])
def test_scans_are_read_from_right_to_left(log, times):
    path = log(
        scan([1.0, 2.5, 81.9], [1, 1, 0], pose=1),
        scan([3.0, 4.0, 5.0], [1, 1, 1], from_right=False),
        times=times,
    )
    found = rawlog.read(path)
    np.testing.assert_allclose(found.angles, [-np.pi / 2, 0.0, np.pi / 2], rtol=1e-6)
    np.testing.assert_array_equal(found.ranges, [[1.0, 2.5, np.inf], [5.0, 4.0, 3.0]])


@pytest.mark.parametrize(
    ("scans", "reason"),
    [
        ([b""], "holds no laser scans"),
        ([scan([1.0], [1], version=7)], "version of a laser scan = 7: must be 6"),
        ([scan([1.0], [1], pose=b"\x87CPose2D\x00")], "is damaged, or the pose of its scanner"),
        ([scan([1.0], [1], pose=b"\x87CPose3D\x03")], "is damaged, or the pose of its scanner"),
        ([scan([1.0, 2.0], [1, 1])[:-1]], "ends early"),
        ([scan([1.0], [1])[:30]], "unpack_from requires"),
        ([scan([1.0], [1]), scan([1.0, 2.0], [1, 1])], "holds scans of several scanners"),
        ([scan([1.0], [1]), scan([1.0], [1], aperture=1.0)], "holds scans of several scanners"),
    ],
)
def test_what_cannot_be_read_is_named_in_one_line(log, scans, reason):
    path = log(*scans)
    with pytest.raises(ValueError, match=reason) as error:
        rawlog.read(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.skipif(not rawlog.DIRECTORY.exists(), reason="mrpt-common is not installed")
def test_logs_of_debian_hold_704_scans():
    each = [rawlog.read(rawlog.DIRECTORY / name).ranges for name in rawlog.LOGS]
    assert [ranges.shape for ranges in each] == [(225, 361), (37, 361), (343, 361), (99, 361)]
    found = rawlog.read_logs()
    np.testing.assert_array_equal(found.ranges, np.concatenate(each))
    np.testing.assert_allclose(np.degrees(found.angles), np.arange(361) / 2 - 90, atol=1e-4)
    # In centimetres, up to 80 m.
    ranges = found.ranges[np.isfinite(found.ranges)].astype(float)
    np.testing.assert_allclose(100 * ranges, np.round(100 * ranges), atol=0.01)
    assert 0.1 <= ranges.min() < ranges.max() < 82.0
    assert 0.9 < ranges.size / found.ranges.size < 1.0


@pytest.mark.parametrize("damage", [lambda x: x[:-9], lambda x: x[:20] + b"\xff" * 30 + x[50:]])
def test_a_log_that_is_not_whole_is_named(log, damage):
    path = log(scan(np.ones(300), np.ones(300)))
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(ValueError, match=f"{path} is not a complete gzip file: "):
        rawlog.read(path)
