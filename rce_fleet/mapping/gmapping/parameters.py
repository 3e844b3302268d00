"""The parameters of ``gmapping/slam_gmapping``, with ROS 1's names and defaults (wiki.ros.org/gmapping)."""

from __future__ import annotations

from dataclasses import dataclass, field

_POSITIVE = {"above": 0}
_NOT_NEGATIVE = {"minimum": 0}


@dataclass(frozen=True)
class FilterParameters:
    """Parameters of the filter. Names of ROS that Python's conventions do not allow stand in the metadata.

    Attributes:
        particles: Number of particles.
        max_range: ``maxRange``: the laser's greatest range, metres; 0 takes the laser's own.
        max_usable_range: ``maxUrange``: readings beyond are free up to here and not matched, metres; 0 takes
            maxRange.
        sigma: Width of the matching score: a beam counts ``exp(-d * d / sigma)``.
        kernel_size: ``kernelSize``: cells around a beam's end in which GMapping looks for a wall; here it is
            always found within 6 cells, and greater values are refused.
        linear_step: ``lstep``: step of the coarse search, metres.
        angular_step: ``astep``: step of the coarse search, radians.
        iterations: Rounds of the matcher, two Gauss-Newton steps each.
        lsigma: Width of the likelihood of a beam.
        gain: ``ogain``: how much the likelihood is smoothed before particles are compared.
        skip: ``lskip``: beams that are left out between two used ones for the likelihood.
        minimum_score: ``minimumScore``: a match with a lower score is refused, and odometry is used.
        srr: Translation's error from translation, a share.
        srt: Rotation's error from translation, radians per metre.
        str_: ``str``: translation's error from rotation, metres per radian.
        stt: Rotation's error from rotation, a share.
        linear_update: ``linearUpdate``: a scan is used after this way, metres.
        angular_update: ``angularUpdate``: or after this turn, radians.
        temporal_update: ``temporalUpdate``: or after this time, seconds; below 0 never.
        resample_threshold: ``resampleThreshold``: particles are drawn anew if their effective number is below
            this share.
        delta: Edge of a cell, metres.
        ll_sample_range: ``llsamplerange``: poses up to so far around a match are compared for its likelihood,
            metres.
        ll_sample_step: ``llsamplestep``: distance of these poses, metres.
        la_sample_range: ``lasamplerange``: the same for headings, radians.
        la_sample_step: ``lasamplestep``: the same for headings, radians.
        occupied_threshold: ``occ_thresh``: cells that were hit in a greater share of visits are occupied.
    """

    particles: int = field(default=30, metadata={"minimum": 1, "maximum": 1000})
    max_range: float = field(default=0.0, metadata={"name": "maxRange", **_NOT_NEGATIVE})
    max_usable_range: float = field(default=0.0, metadata={"name": "maxUrange", **_NOT_NEGATIVE})
    sigma: float = field(default=0.05, metadata=_POSITIVE)
    kernel_size: int = field(default=1, metadata={"name": "kernelSize", "minimum": 1, "maximum": 6})
    linear_step: float = field(default=0.05, metadata={"name": "lstep", **_POSITIVE})
    angular_step: float = field(default=0.05, metadata={"name": "astep", **_POSITIVE})
    iterations: int = field(default=5, metadata={"minimum": 1, "maximum": 100})
    lsigma: float = field(default=0.075, metadata=_POSITIVE)
    gain: float = field(default=3.0, metadata={"name": "ogain", **_POSITIVE})
    skip: int = field(default=0, metadata={"name": "lskip", **_NOT_NEGATIVE})
    minimum_score: float = field(default=0.0, metadata={"name": "minimumScore", **_NOT_NEGATIVE})
    srr: float = field(default=0.1, metadata=_NOT_NEGATIVE)
    srt: float = field(default=0.2, metadata=_NOT_NEGATIVE)
    str_: float = field(default=0.1, metadata={"name": "str", **_NOT_NEGATIVE})
    stt: float = field(default=0.2, metadata=_NOT_NEGATIVE)
    linear_update: float = field(default=1.0, metadata={"name": "linearUpdate", **_NOT_NEGATIVE})
    angular_update: float = field(default=0.5, metadata={"name": "angularUpdate", **_NOT_NEGATIVE})
    temporal_update: float = field(default=-1.0, metadata={"name": "temporalUpdate"})
    resample_threshold: float = field(
        default=0.5, metadata={"name": "resampleThreshold", "minimum": 0, "maximum": 1}
    )
    delta: float = field(default=0.05, metadata=_POSITIVE)
    ll_sample_range: float = field(default=0.01, metadata={"name": "llsamplerange", **_NOT_NEGATIVE})
    ll_sample_step: float = field(default=0.01, metadata={"name": "llsamplestep", **_POSITIVE})
    la_sample_range: float = field(default=0.005, metadata={"name": "lasamplerange", **_NOT_NEGATIVE})
    la_sample_step: float = field(default=0.005, metadata={"name": "lasamplestep", **_POSITIVE})
    occupied_threshold: float = field(
        default=0.25, metadata={"name": "occ_thresh", "minimum": 0, "maximum": 1}
    )
