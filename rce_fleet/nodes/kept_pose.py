"""A robot's pose that outlives the localization, and its file, which outlives the robot's restart."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np

from rce_fleet.geometry.angles import wrap
from rce_fleet.geometry.jumps import OdometryWatch, has_begun_anew
from rce_fleet.geometry.poses import Pose

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class KeptPose:
    """A pose on the map and the odometry of the same moment.

    Attributes:
        frame: Frame of the map.
        pose: On the map.
        covariance: Of the pose, shape (3, 3): x, y, yaw.
        odometry: Pose by odometry.
    """

    frame: str
    pose: Pose
    covariance: NDArray[np.float64]
    odometry: Pose

    def moved_on(self, odometry: Pose, share: float, least: float) -> tuple[Pose, NDArray[np.float64]]:
        """Return the pose on the map, and its covariance, for a later pose by odometry.

        Args:
            odometry: The later pose by odometry.
            share: Standard deviation that is added, as a share of the distance; the heading's also grows by
                this share of the turn.
            least: Standard deviation that is added in any case, metres and radians.
        """
        moved = odometry.relative_to(self.odometry)
        added = least + share * hypot(moved.x, moved.y)
        turned = added + share * abs(wrap(moved.yaw))
        return self.pose.compose(moved), self.covariance + np.diag((added**2, added**2, turned**2))


@dataclass(frozen=True, slots=True)
class StoredPose:
    """A kept pose of a former run.

    Attributes:
        kept: The pose.
        boot: Which start of the machine it is of.
        time: When the robot was there, seconds of ROS time.
    """

    kept: KeptPose
    boot: str
    time: float

    def resume(self, odometry: Pose, boot: str, time: float) -> KeptPose:
        """Return the pose with the odometry that the robot has now.

        Within one start of the machine the odometry has gone on, and tells how the robot moved since. Else,
        if it is at its origin again, or farther away than the robot can have driven, it has begun anew: the
        robot is taken to stand where it was.

        Args:
            odometry: Pose by odometry now.
            boot: Which start of the machine this is.
            time: Seconds of ROS time now.
        """
        kept = self.kept
        watch = OdometryWatch()
        watch.check(kept.odometry, self.time)
        is_same = boot == self.boot and not has_begun_anew(kept.odometry, odometry)
        if is_same and not watch.check(odometry, time):
            return kept
        return KeptPose(kept.frame, kept.pose, kept.covariance, odometry)

    def to_json(self) -> str:
        """Return the text from which :meth:`from_json` makes it again."""
        kept = self.kept
        fields = {
            "boot": self.boot,
            "time": self.time,
            "frame": kept.frame,
            "pose": kept.pose.as_array().tolist(),
            "covariance": kept.covariance.tolist(),
            "odometry": kept.odometry.as_array().tolist(),
        }
        return json.dumps(fields)

    @classmethod
    def from_json(cls, text: str) -> StoredPose:
        """Read what :meth:`to_json` wrote.

        Raises:
            ValueError: It is not such a text; the error says what is wrong.
        """
        fields = json.loads(text)
        try:
            pose, odometry = (np.array(fields[name], np.float64) for name in ("pose", "odometry"))
            covariance = np.array(fields["covariance"], np.float64)
            frame, boot, time = str(fields["frame"]), str(fields["boot"]), float(fields["time"])
        except (KeyError, TypeError) as error:
            raise ValueError(f"it has no usable {error}") from error
        if pose.shape != (3,) or odometry.shape != (3,) or covariance.shape != (3, 3):
            raise ValueError("expected a pose and an odometry of 3 numbers and a covariance of 3 x 3")
        if not all(np.isfinite(each).all() for each in (pose, odometry, covariance, time)):
            raise ValueError("it has numbers that are not finite")
        kept = KeptPose(frame, Pose.from_array(pose), covariance, Pose.from_array(odometry))
        return cls(kept, boot, time)

    def write(self, path: Path) -> None:
        """Write the file; the one before is replaced when it is complete.

        Raises:
            OSError: It cannot be written.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        aside = path.with_suffix(".new")
        aside.write_text(self.to_json() + "\n", encoding="utf-8")
        aside.replace(path)


def read_stored_pose(path: Path) -> StoredPose | None:
    """Return what a file stores; None if there is no file.

    Raises:
        OSError: The file cannot be read.
        ValueError: It is not such a file; the text says what is wrong.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    return StoredPose.from_json(text)


def boot_id() -> str:
    """Return which start of the machine this is; empty where the system does not say."""
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def default_path(master_uri: str, node: str, environ: Mapping[str, str] = os.environ) -> Path:
    """Return where a node stores the pose: in ``ROS_HOME`` or ``~/.ros``, a file for each master and node."""
    home = Path(environ["ROS_HOME"]) if environ.get("ROS_HOME") else Path.home() / ".ros"
    master = urlsplit(master_uri)
    name = "_".join((master.hostname or "localhost", str(master.port or 0), *node.strip("/").split("/")))
    return home / "last_pose" / f"{name}.json"
