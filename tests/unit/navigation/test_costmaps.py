"""Layered costmaps: costs, marking, clearing, inflation, rolling windows."""

from __future__ import annotations

from dataclasses import replace
from math import exp, inf, nan, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.navigation.costmap.cost_grid import Area, CostGrid
from rce_fleet.navigation.costmap.costs import (
    FREE,
    INSCRIBED,
    LETHAL,
    UNKNOWN,
    cost_of_distance,
    from_occupancy,
    to_occupancy,
)
from rce_fleet.navigation.costmap.footprint import Footprint
from rce_fleet.navigation.costmap.layered import LayeredCostmap
from rce_fleet.navigation.costmap.observation import observe_points, observe_scan
from rce_fleet.navigation.costmap.obstacle_layer import MAX_KEPT
from rce_fleet.navigation.costmap.parameters import (
    CostmapParameters,
    InflationParameters,
    ObservationSource,
    ObstacleLayerParameters,
    StaticLayerParameters,
)

ORIGIN = Pose(0.0, 0.0, 0.0)
SOURCE = ObservationSource("scan", data_type="LaserScan", clearing=True, inf_is_valid=True)
LOCAL = CostmapParameters(
    rolling_window=True,
    width=4.0,
    height=4.0,
    obstacle_layer=ObstacleLayerParameters(footprint_clearing_enabled=False),
    sources={"scan": SOURCE},
)
BEAMS = 360


def local_costmap(parameters: CostmapParameters = LOCAL) -> LayeredCostmap:
    return LayeredCostmap(parameters, Footprint(0.2))


def scan(costmap: LayeredCostmap, ranges: np.ndarray, at: Pose = ORIGIN, now: float = 0.0) -> None:
    """Give a costmap a scan of beams all around and update it."""
    assert costmap.obstacles is not None
    source = costmap.parameters.sources["scan"]
    step = 2 * pi / len(ranges)
    costmap.obstacles.take("scan", observe_scan(ranges, -pi, step, (0.05, 6.0), at, source, now))
    costmap.update(at, now)


def wall_ahead(distance: float, half_width: float = 0.3) -> np.ndarray:
    """Return the ranges of a wall across x at a distance; elsewhere nothing."""
    angles = -pi + np.arange(BEAMS) * 2 * pi / BEAMS
    ranges = np.full(BEAMS, inf)
    ahead = np.abs(np.tan(angles) * distance) <= half_width
    ahead &= np.cos(angles) > 0
    ranges[ahead] = distance / np.cos(angles[ahead])
    return ranges


# Costs


@pytest.mark.parametrize("distance", [0.2, 0.25, 0.31, 0.4, 0.55])
def test_costs_are_those_of_costmap_2d(distance: float) -> None:
    """computeCost: 254 at 0, 253 up to the inscribed radius, then exp(-factor (d - r)) * 252, truncated."""
    radius, factor = 0.2, 10.0
    expected = INSCRIBED if distance <= radius else int(exp(-factor * (distance - radius)) * 252)
    assert cost_of_distance(distance, radius, factor) == expected
    assert cost_of_distance(0.0, radius, factor) == LETHAL


def test_published_values_are_those_of_costmap_2d() -> None:
    """Costmap2DPublisher's table: 1 + 97 (cost - 1) / 251 between the special values."""
    values = to_occupancy(np.array((FREE, 1, 127, 252, INSCRIBED, LETHAL, UNKNOWN), np.uint8))
    assert values.tolist() == [0, 1, 1 + 97 * 126 // 251, 98, 99, 100, -1]


def test_map_values_become_costs() -> None:
    values = np.array(((-1, 0, 50, 100),), np.int8)
    assert from_occupancy(values).tolist() == [[UNKNOWN, FREE, FREE, LETHAL]]
    assert from_occupancy(values, track_unknown=False)[0, 0] == FREE
    assert from_occupancy(values, trinary=False)[0, 2] == 127
    assert from_occupancy(values, lethal_threshold=50)[0, 2] == LETHAL
    assert from_occupancy(values, lethal_threshold=0, trinary=False).tolist() == [[UNKNOWN, *3 * [LETHAL]]]


@given(
    st.lists(st.tuples(st.integers(0, 39), st.integers(0, 39)), min_size=1, max_size=8),
    st.floats(0.1, 0.6),
    st.floats(1.0, 20.0),
)
def test_inflation_equals_the_formula(cells: list[tuple[int, int]], radius: float, factor: float) -> None:
    """Each cell has the cost of its exact distance to the nearest obstacle, up to the inflation radius."""
    picture = np.zeros((40, 40), np.int8)
    picture[tuple(np.array(cells).T)] = 100
    parameters = CostmapParameters(
        static_layer=StaticLayerParameters(),
        inflation_layer=InflationParameters(inflation_radius=radius, cost_scaling_factor=factor),
    )
    costmap = LayeredCostmap(parameters, Footprint(0.12))
    costmap.set_map(OccupancyMap(picture, 0.05))
    costmap.update(ORIGIN, 0.0)
    rows, columns = np.mgrid[0:40, 0:40]
    squared = np.min([(rows - row) ** 2 + (columns - column) ** 2 for row, column in cells], axis=0)
    expected = cost_of_distance(np.sqrt(squared) * 0.05, 0.12, factor)
    expected[squared > np.ceil(radius / 0.05) ** 2] = FREE
    assert (costmap.grid.values == expected).all()


# The map


def test_a_static_costmap_takes_the_size_of_its_map() -> None:
    costmap = LayeredCostmap(CostmapParameters(static_layer=StaticLayerParameters()), Footprint(0.2))
    ready = costmap.is_ready
    assert not ready
    picture = np.zeros((20, 30), np.int8)
    picture[3, 7] = 100
    costmap.set_map(OccupancyMap(picture, 0.1, Pose(-1.0, -2.0, 0.0)))
    costmap.update(ORIGIN, 0.0)
    assert costmap.is_ready
    assert costmap.grid.shape == (20, 30)
    assert costmap.grid.cost_at(-1.0 + 0.75, -2.0 + 0.35) == LETHAL
    assert np.count_nonzero(costmap.grid.values) == 1


def test_a_rotated_map_is_sampled_at_its_place() -> None:
    """A map that is turned by 90 degrees puts its cells left of its origin."""
    parameters = replace(LOCAL, static_layer=StaticLayerParameters(), obstacle_layer=None, sources={})
    costmap = LayeredCostmap(parameters, Footprint(0.2))
    picture = np.zeros((10, 10), np.int8)
    picture[:, 5:] = 100  # columns grow along y of the world
    costmap.set_map(OccupancyMap(picture, 0.1, Pose(1.0, -0.5, pi / 2)))
    costmap.update(ORIGIN, 0.0)
    assert costmap.grid.cost_at(0.5, 0.25) == LETHAL
    assert costmap.grid.cost_at(0.5, -0.25) == FREE


@pytest.mark.parametrize("yaw", [pi / 2, -pi / 2, pi, 0.3, -2.0])
def test_a_costmap_covers_all_of_a_rotated_map(yaw: float) -> None:
    picture = np.full((20, 50), 100, np.int8)
    drawn = OccupancyMap(picture, 0.1, Pose(1.0, -2.0, yaw))
    costmap = LayeredCostmap(CostmapParameters(static_layer=StaticLayerParameters()), Footprint(0.2))
    costmap.set_map(drawn)
    costmap.update(ORIGIN, 0.0)
    places = drawn.cell_to_world(np.argwhere(picture > 0).reshape(20, 50, 2)[1:-1, 1:-1].reshape(-1, 2))
    assert (costmap.grid.costs_at(places, outside=UNKNOWN) == LETHAL).all()
    lethal = np.argwhere(costmap.grid.values == LETHAL)
    assert len(lethal) == pytest.approx(picture.size, rel=0.05)
    assert (drawn.values_at(costmap.grid.centres_of(lethal)) == 100).all()


def test_an_update_replaces_a_part_of_the_map() -> None:
    costmap = LayeredCostmap(CostmapParameters(static_layer=StaticLayerParameters()), Footprint(0.2))
    costmap.set_map(OccupancyMap(np.zeros((10, 10), np.int8), 0.1))
    costmap.update(ORIGIN, 0.0)
    assert costmap.static is not None
    costmap.static.update_map(np.full((2, 3), 100, np.int8), 4, 5)
    assert costmap.update(ORIGIN, 1.0) == Area(0, 0, 10, 10)
    assert np.argwhere(costmap.grid.values == LETHAL).tolist() == [[r, c] for r in (4, 5) for c in (5, 6, 7)]
    with pytest.raises(ValueError, match="outside the map"):
        costmap.static.update_map(np.full((2, 3), 100, np.int8), 9, 9)


@pytest.mark.parametrize(
    "place", [(-3.0, 1.0), (1.0, -3.0), (-3.0, -3.0), (9.0, 1.0), (1.0, 9.0), (9.0, -3.0)]
)
def test_around_a_place_off_the_costmap_is_no_cell(place: tuple[float, float]) -> None:
    grid = CostGrid(40, 60, 0.1)
    assert grid.values[grid.area_around(*place, 0.5).slices].size == 0


@pytest.mark.parametrize(("persistence", "most"), [(0.0, 1), (5.0, MAX_KEPT)])
def test_while_time_stands_still_few_observations_are_kept(persistence: float, most: int) -> None:
    """A simulation that is paused may publish scans; each update uses all that are kept."""
    source = replace(SOURCE, observation_persistence=persistence)
    costmap = local_costmap(replace(LOCAL, sources={"scan": source}))
    assert costmap.obstacles is not None
    for step in range(1200):
        at = Pose(1e-4 * step, 0.0, 0.0)
        seen = observe_scan(wall_ahead(1.0)[::90], -pi, pi / 2, (0.05, 6.0), at, source, 7.0)
        costmap.obstacles.take("scan", seen)
    kept = costmap.obstacles._kept["scan"]
    assert len(kept) == most
    assert kept[-1].x == pytest.approx(0.1199)


def test_clearing_computes_costs_anew_where_marks_were() -> None:
    """Of a large floor the rest stays as it is: it would take a second, in which the robot is not driven."""
    picture = np.zeros((200, 300), np.int8)
    picture[::20] = 100
    parameters = CostmapParameters(
        static_layer=StaticLayerParameters(),
        obstacle_layer=ObstacleLayerParameters(),
        inflation_layer=InflationParameters(inflation_radius=0.3),
    )
    costmap = LayeredCostmap(parameters, Footprint(0.2))
    costmap.set_map(OccupancyMap(picture, 0.1))
    costmap.update(ORIGIN, 0.0)
    before = costmap.grid.values.copy()
    assert costmap.obstacles is not None
    costmap.obstacles._mark(costmap.grid, np.array(((10.05, 5.05), (10.45, 5.55))))
    assert costmap.update(ORIGIN, 0.1) == Area(0, 0, 0, 0)
    costmap.clear()
    assert costmap.update(ORIGIN, 0.2) == Area(47, 97, 59, 108)
    assert (costmap.grid.values == before).all()
    costmap.obstacles._mark(costmap.grid, np.array(((10.05, 5.05), (20.05, 5.55))))
    costmap.clear_outside(Pose(10.0, 5.0, 0.0), 1.0)
    costmap.update(ORIGIN, 0.3)
    assert costmap.grid.cost_at(10.05, 5.05) == LETHAL
    costmap.clear()
    costmap.update(ORIGIN, 0.4)
    assert (costmap.grid.values == before).all()


def test_clearing_around_a_robot_off_the_map_keeps_nothing() -> None:
    parameters = CostmapParameters(obstacle_layer=ObstacleLayerParameters(), width=4.0, height=4.0)
    costmap = LayeredCostmap(parameters, Footprint(0.2))
    assert costmap.obstacles is not None
    costmap.obstacles._mark(costmap.grid, np.array(((1.0, 1.0), (2.0, 2.0))))
    costmap.clear_outside(Pose(-2.0, -2.0, 0.0), 1.0)
    costmap.update(ORIGIN, 0.0)
    assert not (costmap.grid.values == LETHAL).any()


# Sensors


def test_hits_mark_cells_and_rays_clear_them() -> None:
    costmap = local_costmap()
    scan(costmap, wall_ahead(1.0))
    assert costmap.grid.cost_at(1.001, 0.0) == LETHAL
    assert costmap.grid.cost_at(0.9, 0.0) == FREE
    scan(costmap, np.full(BEAMS, inf), now=0.1)
    assert np.count_nonzero(costmap.grid.values) == 0


def test_hits_beyond_the_obstacle_range_mark_nothing() -> None:
    costmap = local_costmap(replace(LOCAL, width=8.0, height=8.0))
    scan(costmap, wall_ahead(2.6))
    assert np.count_nonzero(costmap.grid.values) == 0


def test_an_obstacle_behind_another_one_stays() -> None:
    """A ray that ends earlier says nothing about cells farther away."""
    costmap = local_costmap()
    scan(costmap, wall_ahead(1.5))
    scan(costmap, wall_ahead(1.0), now=0.1)
    assert costmap.grid.cost_at(1.501, 0.0) == LETHAL
    assert costmap.grid.cost_at(1.001, 0.0) == LETHAL


def test_nan_and_infinite_ranges_are_no_obstacles() -> None:
    costmap = local_costmap(replace(LOCAL, sources={"scan": replace(SOURCE, inf_is_valid=False)}))
    scan(costmap, wall_ahead(1.0))
    scan(costmap, np.full(BEAMS, nan), now=0.1)
    scan(costmap, np.full(BEAMS, inf), now=0.2)
    scan(costmap, np.full(BEAMS, -1.0), now=0.3)
    assert costmap.grid.cost_at(1.001, 0.0) == LETHAL  # nothing was seen to be free
    assert np.count_nonzero(costmap.grid.values == LETHAL) == np.count_nonzero(costmap.grid.values)


def test_a_sparse_sensor_clears_only_along_its_rays() -> None:
    costmap = local_costmap()
    scan(costmap, wall_ahead(1.0))
    marked = np.count_nonzero(costmap.grid.values)
    scan(costmap, np.full(4, inf), now=0.1)  # rays at -180, -90, 0 and 90 degrees
    assert costmap.grid.cost_at(1.001, 0.0) == FREE
    assert 0 < marked - np.count_nonzero(costmap.grid.values) <= 3


def test_points_are_used_within_the_heights_only() -> None:
    costmap = local_costmap()
    assert costmap.obstacles is not None
    points = np.array(((1.0, 0.0, 0.5), (0.0, 1.0, 2.5), (-1.0, 0.0, -0.1), (nan, 0.0, 0.5)))
    costmap.obstacles.take("scan", observe_points(points, ORIGIN, SOURCE, 0.0))
    costmap.update(ORIGIN, 0.0)
    assert costmap.grid.cost_at(1.0, 0.0) == LETHAL
    assert np.count_nonzero(costmap.grid.values) == 1


def test_a_rolling_window_keeps_marks_at_their_place() -> None:
    costmap = local_costmap()
    scan(costmap, wall_ahead(1.013))
    marks = sorted(map(tuple, costmap.obstacles_near(1.0, 0.0, 0.5).round(4).tolist()))
    costmap.update(Pose(0.6, 0.3, 1.0), 0.1)
    assert costmap.grid.has(2.55, 2.25)
    assert not costmap.grid.has(-1.45, 0.0)
    assert sorted(map(tuple, costmap.obstacles_near(1.0, 0.0, 0.5).round(4).tolist())) == marks
    scan(costmap, np.full(BEAMS, inf), Pose(9.0, 0.0, 0.0), 0.2)
    costmap.update(ORIGIN, 0.3)
    assert len(costmap.obstacles_near(1.0, 0.0, 0.5)) == 0


def test_obstacle_points_are_finer_than_cells() -> None:
    """The point of a marked cell is the one that was hit, not the cell's centre."""
    costmap = local_costmap()
    scan(costmap, wall_ahead(1.013))
    points = costmap.obstacles_near(1.0, 0.0, 0.5)
    assert len(points) > 5
    assert points[:, 0] == pytest.approx(1.013, abs=1e-4)


def test_cells_under_the_robot_are_cleared() -> None:
    layer = ObstacleLayerParameters(footprint_clearing_enabled=True)
    costmap = local_costmap(replace(LOCAL, obstacle_layer=layer))
    scan(costmap, np.full(BEAMS, 0.1))
    assert costmap.grid.cost_at(0.1, 0.0) == FREE


def test_clearing_keeps_a_square_around_the_robot() -> None:
    costmap = local_costmap()
    scan(costmap, np.minimum(wall_ahead(1.5), np.roll(wall_ahead(0.6), BEAMS // 2)))
    assert costmap.grid.cost_at(1.501, 0.0) == LETHAL
    costmap.clear_outside(ORIGIN, 2.0)
    costmap.update(ORIGIN, 0.1)
    assert costmap.grid.cost_at(1.501, 0.0) == FREE
    assert costmap.grid.cost_at(-0.601, 0.0) == LETHAL


def test_a_late_source_is_named() -> None:
    late = replace(SOURCE, expected_update_rate=0.5)
    costmap = local_costmap(replace(LOCAL, sources={"scan": late}))
    assert costmap.obstacles is not None
    assert costmap.obstacles.late_sources(0.0) == ["scan"]
    scan(costmap, np.full(BEAMS, inf), now=1.0)
    assert costmap.obstacles.late_sources(1.4) == []
    assert costmap.obstacles.late_sources(1.6) == ["scan"]


@given(st.floats(-3, 3), st.floats(-3, 3), st.lists(st.floats(0.1, 4.0), min_size=24, max_size=24))
def test_updates_of_areas_equal_a_whole_update(x: float, y: float, ranges: list[float]) -> None:
    """A costmap that is updated step by step has the costs of one that begins with the last scan."""
    parameters = replace(LOCAL, width=8.0, height=8.0, inflation_layer=InflationParameters())
    parameters = replace(parameters, rolling_window=False, origin_x=-4.0, origin_y=-4.0)
    one, other = local_costmap(parameters), local_costmap(parameters)
    at = Pose(x, y, 0.0)
    scan(one, wall_ahead(1.0), ORIGIN)
    scan(one, np.array(ranges), at, 0.1)
    other.obstacles = one.obstacles
    other._layers = one._layers  # the same marks, all of the costs anew
    other.update(at, 0.1)
    assert (one.grid.values == other.grid.values).all()


def test_a_costmap_without_size_is_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        CostGrid(0, 10, 0.05)
    with pytest.raises(ValueError, match="above 0"):
        CostGrid(10, 10, 0.0)


# Footprints


def test_a_footprint_is_read_as_costmap_2d_reads_it() -> None:
    square = Footprint.read("[[-0.2, -0.1], [-0.2, 0.1], [0.3, 0.1], [0.3, -0.1]]", 0.0, 0.01)
    assert square.polygon[2].tolist() == pytest.approx([0.31, 0.11])
    assert square.inscribed_radius == pytest.approx(0.11)
    assert square.circumscribed_radius == pytest.approx(np.hypot(0.31, 0.11))
    disc = Footprint.read("[]", 0.2, 0.01)
    assert disc.is_round
    assert disc.radius == pytest.approx(0.21)


@pytest.mark.parametrize("footprint", ["[[0, 0", "[1, 2, 3]", [["a", 1]]])
def test_a_bad_footprint_is_refused(footprint: object) -> None:
    with pytest.raises(ValueError, match="footprint: expected"):
        Footprint.read(footprint, 0.2)


def test_a_footprint_beside_the_robot_is_refused() -> None:
    with pytest.raises(ValueError, match="around the robot"):
        Footprint.read([[1, 1], [2, 1], [2, 2]], 0.2)


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-pi, pi), st.floats(-2, 2), st.floats(-2, 2))
def test_clearance_of_a_polygon_is_exact(x: float, y: float, yaw: float, px: float, py: float) -> None:
    """It is the distance to the nearest point of the outline, found by sampling it; negative inside."""
    footprint = Footprint(corners=((0.3, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.3, -0.2)))
    clear = footprint.clearance(np.array(((x, y, yaw),)), np.array(((px, py),)), enough=5.0)[0]
    corners = footprint.at(x, y, yaw)
    share = np.linspace(0, 1, 401)[:, None]
    outline = np.concatenate(
        [a + share * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    away = float(np.hypot(*(outline - (px, py)).T).min())
    c, s = np.cos(yaw), np.sin(yaw)
    local = (c * (px - x) + s * (py - y), c * (py - y) - s * (px - x))
    inside = -0.2 < local[0] < 0.3 and abs(local[1]) < 0.2
    assert clear == pytest.approx(-away if inside else away, abs=2e-3)
