"""The raw feature generator F: (Scene, Trajectory) -> [T, F].

Which columns, in which order, with which units and caps, is read from
data_specs/features/<preset>.toml; how a column is computed stands in
`columns.py`. A user's own terms (`terms.py`) are a preset by their place,
FILE.py:NAME. Human and sampled trajectories go through the same function.
"""

import dataclasses
import functools
import math
from pathlib import Path

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rcirl_jax.errors import InputError
from rcirl_jax.features.columns import (
    BEFORE_M,
    COLUMNS,
    OF_CANDIDATE_AT_START,
    Frame,
    PathView,
    path_view,
    relate,
    slots,
)
from rcirl_jax.features.terms import OwnTerms, own_terms
from rcirl_jax.runtime.specs import load_toml, spec_root
from rcirl_jax.runtime.user_code import is_python
from rcirl_jax.types import Candidates, Scene, Trajectory
from rcirl_jax.units import TIMES_S

UNBOUNDED = 1e30  # reach of features of which none is known


def make_frame(scene: Scene, trajectory: Trajectory) -> Frame:
    """The frames of one trajectory; every leaf is [T]."""
    view = path_view(scene, trajectory.s)
    points = jax.tree.map(lambda x: x[:, None], (trajectory, view))
    frame = _grid(scene, *points)
    return jax.tree.map(lambda x: x[:, 0], frame)


def candidate_frames(scene: Scene, trajectories: Trajectory) -> Frame:
    """The frames of K trajectories [K, T] of a scene; every leaf is [T, K].

    Candidates run along the last axis, so that XLA's loops are long and all
    lanes of the processor's vectors are filled.
    """
    view = jax.vmap(path_view, in_axes=(None, 0))(scene, trajectories.s)
    leaves, tree = jax.tree.flatten((trajectories, view))
    points = jnp.stack(leaves).swapaxes(1, 2)  # one copy instead of one a leaf
    return _grid(scene, *jax.tree.unflatten(tree, points))


def _grid(scene: Scene, trajectory: Trajectory, view: PathView) -> Frame:
    """Frames of a [T, K] grid of points; the one place that maps over points."""
    s = trajectory.s
    before = jnp.concatenate([jnp.full_like(s[:1], -BEFORE_M), s[:-1]])
    kappa = view.curvature(trajectory)

    def row(time: jax.Array, obstacles: tuple, s: jax.Array, *rest: jax.Array) -> tuple:
        one = jax.vmap(relate, in_axes=(None, 0, 0, 0, 0))
        return jnp.broadcast_to(time, s.shape), one(obstacles, s, *rest)

    obstacle_slots = slots(scene.ego, scene.obstacles)
    time, relations = jax.vmap(row)(
        jnp.asarray(TIMES_S), obstacle_slots, s, trajectory.l, trajectory.v, before
    )
    return Frame(
        time=time,
        advance=s - scene.ego.s,
        point=trajectory,
        relations=relations,
        path=view,
        kappa=kappa,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureSpec:
    """One declared feature; see data_specs/features/paper21.toml."""

    name: str  # key of COLUMNS
    unit: str
    none: float  # value without an obstacle of the class
    lower: float  # the normaliser clips below
    upper: float  # and above
    meaning: str


@dataclasses.dataclass(frozen=True)
class FeatureMap:
    """F with its declared columns; hashable, so it may be a static argument."""

    preset: str
    specs: tuple[FeatureSpec, ...]
    # safety terms: 1 the reward may not fall with it, -1 may not rise, 0 free
    signs: tuple[int, ...] = ()
    # in the place of the package's columns
    own: OwnTerms | None = None

    @property
    def context(self) -> tuple[int, ...]:
        """Per feature: 1 if all candidates of a scene share it at t = 0."""
        if self.own:
            return (0,) * self.num_features  # nothing is known of them
        return tuple(int(name not in OF_CANDIDATE_AT_START) for name in self.names)

    @property
    def names(self) -> tuple[str, ...]:
        """Feature names in column order."""
        return tuple(spec.name for spec in self.specs)

    @property
    def num_features(self) -> int:
        """F, the number of columns."""
        return len(self.specs)

    def __call__(
        self, scene: Scene, trajectory: Trajectory
    ) -> Float[Array, "times features"]:
        """F of one trajectory in one scene, [T, F]; finite for finite inputs."""
        with jax.named_scope("features"):
            if self.own:
                one = jax.tree.map(lambda x: x[None], trajectory)
                columns = [row[:, 0] for row in self.own.rows(scene, one)]
            else:
                frame = make_frame(scene, trajectory)
                columns = [COLUMNS[spec.name](frame) for spec in self.specs]
            return jnp.stack(columns, axis=-1)

    def of_candidates(
        self, scene: Scene, candidates: Candidates
    ) -> Float[Array, "candidates times features"]:
        """F of all K candidates of one scene, [K, T, F]."""
        return jnp.moveaxis(jnp.stack(self.rows(scene, candidates), axis=-1), 0, 1)

    def rows(
        self, scene: Scene, candidates: Candidates
    ) -> tuple[Float[Array, "times candidates"], ...]:
        """F of all K candidates, feature by feature: F arrays [T, K].

        The layout for speed: no [K, T, F] array is ever written.
        """
        return self.of_trajectories(scene, candidates.trajectory)

    def of_trajectories(
        self, scene: Scene, trajectories: Trajectory, frames: Frame | None = None
    ) -> tuple[Float[Array, "times candidates"], ...]:
        """`rows` of K trajectories [K, T], with their `candidate_frames` if made."""
        with jax.named_scope("features"):
            if self.own:
                return self.own.rows(scene, trajectories)
            frames = frames or candidate_frames(scene, trajectories)
            return tuple(COLUMNS[spec.name](frames) for spec in self.specs)


def known_presets() -> list[str]:
    """Names of the feature maps declared in data_specs/features."""
    return sorted(item.stem for item in (spec_root() / "features").glob("*.toml"))


@functools.cache
def feature_map(preset: str) -> FeatureMap:
    """The feature map declared in data_specs/features/<preset>.toml, or own terms.

    Raises:
      InputError: no such preset, an unknown column, or a value out of order; own terms
        that are none.
    """
    if is_python(preset):
        own = own_terms(preset)
        specs = tuple(
            FeatureSpec(
                name=name,
                unit="1",
                none=0.0,
                lower=-UNBOUNDED,
                upper=UNBOUNDED,
                meaning="an own term",
            )
            for name in own.names
        )
        return FeatureMap(preset, specs, own=own)
    known = known_presets()
    if preset not in known:
        raise InputError(
            f"preset: {preset}: expected one of {', '.join(known)}, or FILE.py:NAME of "
            "own terms"
        )
    path = spec_root() / "features" / f"{preset}.toml"
    table = load_toml(path)
    rows, safety = table.get("feature", []), table.get("safety", {})
    _check_tables(path, rows, safety)
    specs = tuple(_read_spec(path, row) for row in rows)
    names = [spec.name for spec in specs]
    if not names or len(set(names)) != len(names):
        raise InputError(f"{path}: feature: {names}: expected distinct names")
    rises, falls = safety.get("rises", []), safety.get("falls", [])
    for name in (*rises, *falls):
        if name not in names or (name in rises and name in falls):
            raise InputError(
                f"{path}: safety: {name}: expected a feature above, in one list"
            )
    signs = tuple((n in rises) - (n in falls) for n in names)
    return FeatureMap(preset, specs, signs)


def _check_tables(path: Path, rows: object, safety: object) -> None:
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path}: feature: {rows}: expected [[feature]] tables")
    if not isinstance(safety, dict):
        raise InputError(f"{path}: safety: {safety}: expected a table [safety]")
    for key in ("rises", "falls"):
        names = safety.get(key, [])
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise InputError(f"{path}: safety.{key}: {names}: expected feature names")


def _read_spec(path: Path, row: dict) -> FeatureSpec:
    name = row.get("name", "(no name)")
    for key in ("name", "unit", "meaning"):
        if not isinstance(row.get(key, ""), str):
            raise InputError(f"{path}: feature: {key}: {row[key]}: expected a text")
    expected = {field.name for field in dataclasses.fields(FeatureSpec)}
    if set(row) != expected:
        raise InputError(
            f"{path}: feature {name}: {sorted(row)}: expected {sorted(expected)}"
        )
    if name not in COLUMNS:
        raise InputError(
            f"{path}: feature {name}: unknown: expected one of {sorted(COLUMNS)}"
        )
    bounds = [row["lower"], row["none"], row["upper"]]
    if not all(isinstance(b, float) and math.isfinite(b) for b in bounds):
        raise InputError(f"{path}: feature {name}: {bounds}: expected finite floats")
    if not bounds[0] <= bounds[1] <= bounds[2] or bounds[0] == bounds[2]:
        raise InputError(f"{path}: feature {name}: {bounds}: lower <= none <= upper")
    return FeatureSpec(**row)
