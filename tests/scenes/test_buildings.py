"""Buildings at the corners of built-in scenes."""

import numpy as np
import pytest
import shapely

from tint_sumo.scenes import SCENES, T_INTERSECTION, find_scene
from tint_sumo.scenes.buildings import corner_buildings
from tint_sumo.scenes.layout import layout


@pytest.mark.parametrize("name", SCENES)
def test_buildings_keep_off_the_roads_of_every_scene(name: str) -> None:
    paved = shapely.union_all(layout(find_scene(name)).roads.paved.geometries)
    buildings = [shapely.Polygon(corners) for corners in corner_buildings(find_scene(name), 1.5)]
    assert buildings
    for building in buildings:
        assert building.is_valid and building.area > 4.0
        assert paved.distance(building) == pytest.approx(1.5, abs=0.06)


def test_the_corners_of_the_t_intersection() -> None:
    """Its lower lane begins at y = 0, its stem is 4 m wide; the roads end 22.5 m to each side."""
    left, right = corner_buildings(find_scene(T_INTERSECTION), 1.5)
    block = [(3.5, -20.0), (3.5, -1.5), (22.5, -20.0), (22.5, -1.5)]
    for building, side in ((left, -1.0), (right, 1.0)):
        assert np.array(sorted((side * x_m, y_m) for x_m, y_m in building)) == pytest.approx(np.array(block), abs=0.03)


def test_an_island_that_roads_enclose_is_left_empty() -> None:
    centre = shapely.Point(0.0, 0.0)
    shapes = [shapely.Polygon(corners) for corners in corner_buildings(find_scene("roundabout"), 1.0)]
    assert len(shapes) == 4 and not any(shape.contains(centre) for shape in shapes)
