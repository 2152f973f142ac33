"""The T-intersection at the scale of a town: a street of 200 m, on which traffic drives at 30 to 50 km/h.

The paper's street is 40 m long, and its drivers go at 10 km/h. Here the ego accelerates to 30 km/h on a wider turn, and
needs some 4 s to its goal. Drivers come as a Poisson process, so that there are gaps of seconds between them.
"""

from tint_sumo.config import POPULATIONS, Claim, EgoController, Traffic
from tint_sumo.scenes.registry import register
from tint_sumo.scenes.scene import EgoTask, Scene, View
from tint_sumo.scenes.t_intersection import EGO_EDGES, ROUTES, START_M, Turn, t_network

_HALF_LENGTH_M = 100.0
_TURN = Turn(centre_radius_m=10.0, goal_x_m=15.0)
_TOP_SPEED_MPS = 30.0 / 3.6  # the ego's
_CREEP_MPS = 1.0


@register
def t_intersection_street() -> Scene:
    return Scene(
        name="t_intersection_street",
        title="turn right across one lane of a town street and merge into the other (left-hand traffic)",
        network=t_network(_TURN, _HALF_LENGTH_M, speed_limit_mps=15.0),
        routes=ROUTES,
        ego=EgoTask(
            edges=EGO_EDGES,
            start_m=START_M,
            goal_m=_TURN.goal_m(),
            way=_TURN.way(_HALF_LENGTH_M),
            controller=EgoController(
                desired_speeds_mps=(0.0, _CREEP_MPS, _TOP_SPEED_MPS),
                accel_limit_mps2=2.5,
                unsafe_distance_m=1.0,
                closing_distance_m=1.5,
                closing_speed_mps=3.0,
            ),
        ),
        view=View(-60.0, -14.0, 60.0, 14.0),
        traffic=Traffic(arrivals_per_s=0.3),
        population=POPULATIONS["street"],
        claim=Claim(approach_speed_mps=_CREEP_MPS, reaction_time_s=0.5),
        max_vehicles=20,
        time_limit_s=60.0,
        position_scale_m=_HALF_LENGTH_M,
        speed_scale_mps=_TOP_SPEED_MPS,
    )
