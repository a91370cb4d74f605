"""The package's scenes as the plain structs of `features.py`."""

import numpy as np

from rcirl_jax.export.own_planner import features
from rcirl_jax.types import Kind, Scene

BOX = ("s_lower", "s_upper", "l_lower", "l_upper", "speed", "valid")
PATH = ("kappa", "l", "speed_limit")


def plain_scene(scene: Scene) -> features.Scene:
    """Return one scene in plain numbers; leave out what is never there."""
    ego = {name: float(value) for name, value in vars(scene.ego).items()}
    kinds = np.asarray(scene.obstacles.kind)
    tables = {name: np.asarray(getattr(scene.obstacles, name)) for name in BOX}
    boxes = [
        features.Obstacle(kind=kind, **{name: x[n] for name, x in tables.items()})
        for n, kind in enumerate(kinds.tolist())
        if kind != Kind.NONE and tables["valid"][n].any()
    ]
    return features.Scene(
        ego=features.Ego(**ego),
        path=features.Path(
            **{name: np.asarray(getattr(scene.path, name)) for name in PATH}
        ),
        obstacles=boxes,
        num_valid=int(np.sum(scene.time_valid)),
    )
