"""Parameters of graph mapping: one set for all logs and robots."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class GraphParameters:
    """Parameters of graph mapping.

    Attributes:
        usable_range: Points farther from the laser are not matched, metres.
        point_cell: Of the points of a scan in one cell of this size, one is matched, metres.
        field_cell: Cell size of likelihood fields, metres.
        field_spread: Standard deviation of their Gaussian, metres.
        key_distance: Way after which a scan becomes a keyscan, metres.
        key_turn: Turn after which a scan becomes a keyscan, radians.
        still_distance: Shorter ways are taken from odometry, without matching, metres.
        still_turn: Smaller turns are taken from odometry, radians.
        submap_keys: The newest so many keyscans are what a scan is matched against.
        fewest_points: Scans with fewer usable points are placed by odometry.
        least_score: Least score of a scan that counts as matched.
        odometry_shift: Standard deviation of a shift by odometry: constant, metres.
        odometry_shift_share: ... and share of the way.
        odometry_turn: Standard deviation of a turn by odometry: constant, radians.
        odometry_turn_share: ... share of the turn.
        odometry_turn_by_way: ... and radians per metre of way.
        loop_distance: Keyscans within this distance of each other may close a loop, metres.
        loop_way: A loop has at least this much way between its two keyscans, metres.
        loop_drift: Expected error of the way around a loop, metres per metre.
        loop_reach: Greatest search distance of a loop, metres.
        loop_score: Least score of a loop's match.
        loop_inliers: Least share of a loop's points that lie on the other scans' lines.
        loop_conflicts: Greatest share of a loop's points that the other scans saw through.
        loop_rival: A second best place with this share of the best score makes a loop ambiguous.
        loop_alone: A loop over a shorter way is accepted alone; one over a longer way waits for others,
            metres.
        loop_group: So many loops have to agree.
        join_group: So many loops have to agree before they join two robots.
        join_spread: These loops are spread over at least this way, metres.
        join_disagreement: Loops that disagree with them are at most this share of them.
        join_conflicts: Greatest share of points that the robots saw through on each other's way.
        undo_conflicts: A join is undone if robots saw through more than this share of points afterwards.
        loop_spread: The loops of a group are spread over at least this way, metres.
        join_places: So many places of other parts are tried for each keyscan of a robot that is not joined.
    """

    usable_range: float = 30.0
    point_cell: float = 0.04
    field_cell: float = 0.05
    field_spread: float = 0.06
    key_distance: float = 0.3
    key_turn: float = 0.25
    still_distance: float = 0.02
    still_turn: float = 0.01
    submap_keys: int = 12
    fewest_points: int = 20
    least_score: float = 0.35
    odometry_shift: float = 0.05
    odometry_shift_share: float = 0.2
    odometry_turn: float = 0.03
    odometry_turn_share: float = 0.15
    odometry_turn_by_way: float = 0.05
    loop_distance: float = 3.0
    loop_way: float = 12.0
    loop_drift: float = 0.02
    loop_reach: float = 6.0
    loop_score: float = 0.5
    loop_inliers: float = 0.6
    loop_conflicts: float = 0.1
    loop_rival: float = 0.85
    loop_alone: float = 15.0
    loop_group: int = 2
    join_group: int = 5
    join_spread: float = 3.0
    join_disagreement: float = 0.5
    join_conflicts: float = 0.08
    undo_conflicts: float = 0.25
    loop_spread: float = 0.25
    join_places: int = 4
