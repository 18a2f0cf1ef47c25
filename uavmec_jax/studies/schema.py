"""The schema of study files.

The numbers of Table 1 and the hyperparameters are declared once (:class:`Params`, :data:`ALGORITHMS`); their models
(:data:`SETTINGS`, :class:`ParamsSettings`) are made from those declarations.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Literal, get_args

import pydantic
from pydantic import Field

from uavmec_jax.agents.registry import ALGORITHMS, MAX_STEPS, check_end
from uavmec_jax.agents.settings import SETTINGS
from uavmec_jax.env.fleet import MAX_UAVS
from uavmec_jax.env.rewards import DEFAULT_REWARD, LOG_GUARDS
from uavmec_jax.files.validation import PrintableText, StrictModel, from_array
from uavmec_jax.planning.beam import WIDTH as BEAM_WIDTH
from uavmec_jax.planning.heuristics import FLEET_HEURISTICS, HEURISTICS
from uavmec_jax.planning.rollout_planner import SAMPLES as ROLLOUT_SAMPLES
from uavmec_jax.scenarios.distribution import ScenarioSettings, check_scenarios
from uavmec_jax.scenarios.inventory import check_depots
from uavmec_jax.scenarios.schema import DepotSettings, Metres, label
from uavmec_jax.scenarios.settings import ParamsSettings, check_ranges
from uavmec_jax.studies.axes import MAX_WEIGHT, TRAFFIC_WEIGHTS, check_axes, check_reward, expected_depots

DQNSettings: Any = SETTINGS["dqn"]
PQNSettings: Any = SETTINGS["pqn"]
PPOSettings: Any = SETTINGS["ppo"]
A2CSettings: Any = SETTINGS["a2c"]

AlgorithmName: Any = Literal[(*ALGORITHMS, "none")]
Guard: Any = Literal[LOG_GUARDS]
Heuristic: Any = Literal[tuple(FLEET_HEURISTICS)]

_RewardWeight = Annotated[float, Field(ge=0, le=MAX_WEIGHT)]

Planner = Literal["rollout", "beam", "bound"]
PLANNERS: tuple[Planner, ...] = get_args(Planner)
"""In the order of their lifetimes: without knowledge of the future, clairvoyant, and the upper bound on every policy."""

CLAIRVOYANT: tuple[Planner, ...] = ("beam", "bound")
"""Those that know the volumes in advance."""


def _planner_draws(settings: dict[str, Any]) -> int:
    """Return the default number of draws that planners are evaluated on."""
    return min(8, settings.get("draws", 8))


class Evaluation(StrictModel):
    """How policies are evaluated."""

    draws: Annotated[int, Field(ge=1, le=10_000)] = 32
    """Held-out volume draws per agent; besides, there is one fixed draw, the same for every agent."""
    validate_every: Annotated[int, Field(ge=1)] = 10_000
    """Environment steps of one agent between validations of the greedy policy."""
    validation_draws: Annotated[int, Field(ge=1, le=1000)] = 16
    baselines: Annotated[tuple[Heuristic, ...], from_array] = tuple(HEURISTICS)
    """Heuristics that are evaluated on the same draws as the trained policies."""
    planners: Annotated[tuple[Planner, ...], from_array] = PLANNERS
    """Planners and the bound, which show how far policies are from the optimum; see ``docs/planning.md``."""
    planner_draws: Annotated[int, Field(ge=1, le=10_000)] = Field(default_factory=_planner_draws)
    """Number of held-out draws, from the first on, that planners are evaluated on; by default 8, or all if they are fewer."""
    clairvoyant_seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...] | None, from_array] = None
    """Numbers of seeds, from the first on, that beam and bound are evaluated on, which take longest: that for one UAV, for
    two, and so on; the last number holds for more UAVs. By default, all seeds."""
    rollout_samples: Annotated[int, Field(ge=1, le=1000)] = ROLLOUT_SAMPLES
    beam_width: Annotated[int, Field(ge=1, le=100_000)] = BEAM_WIDTH

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Evaluation":
        if self.planner_draws > self.draws:
            raise ValueError(
                f"evaluation.planner_draws is {self.planner_draws}; give at most evaluation.draws, which is {self.draws}"
            )
        return self


class StudyDepot(DepotSettings):
    """One depot of a study."""

    x_m: Metres
    y_m: Metres


class Study(StrictModel):
    """A study; its population is the product of its axes."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$", max_length=80)] = "study"
    description: Annotated[str, Field(max_length=10_000)] = ""
    algorithm: AlgorithmName = "dqn"
    """``none`` trains nothing and evaluates heuristics and planners only. Several algorithms are an axis."""
    reward: str | dict[str, float] = DEFAULT_REWARD
    guard: Guard = "clamp"
    steps: Annotated[int, Field(ge=1, le=MAX_STEPS)] = 1_000_000
    """Environment steps of one agent."""
    place: PrintableText = ""
    """A place whose evacuation was simulated, by name or file; if empty, positions are random and traffic is unknown."""
    place_scale_m: Annotated[float, Field(ge=1, le=1e7)] | None = None
    """Length to which the longer side of a place is scaled (800 in the paper); by default distances are real."""
    traffic: Literal["static", "moving"] = "static"
    """Whether a device's traffic weight is its mean over the evacuation, or that of the present window."""
    traffic_bonus: _RewardWeight = 0.0
    """Added to the reward when a device is visited, times its traffic weight."""
    traffic_penalty: _RewardWeight = 0.0
    """Subtracted from the reward when a device is the first to fail, times its traffic weight."""
    slot_reward: _RewardWeight = 0.0
    """Added to the reward for every slot that counts toward the lifetime."""
    scenarios: ScenarioSettings | None = None
    """Distribution from which every episode draws a scenario; it replaces the axes ``powered`` and ``connected``."""
    uavs: Annotated[int, Field(ge=1, le=MAX_UAVS)] = 1
    """Number of UAVs, all like that of ``params``."""
    depot: Annotated[tuple[StudyDepot, ...], from_array] = ()
    """Where UAVs swap or charge their batteries."""
    depots: Annotated[int, Field(ge=0)] | None = None
    """How many of the tables ``depot`` are there, the first ones; by default all of them."""
    axes: dict[str, Any]
    """``powered`` and ``connected``, or ``cells`` (pairs of the two); ``seeds`` (a number or a list); ``algorithm``,
    ``reward``, ``guard``, ``place``, ``traffic_bonus``, ``traffic_penalty``, ``uavs``, ``depots``, or any traced setting."""
    dqn: DQNSettings = DQNSettings()
    pqn: PQNSettings = PQNSettings()
    ppo: PPOSettings = PPOSettings()
    a2c: A2CSettings = A2CSettings()
    params: ParamsSettings = ParamsSettings()
    evaluation: Evaluation = Evaluation()

    @property
    def algorithms(self) -> tuple[str, ...]:
        """Names of the algorithms that the study trains."""
        if self.algorithm == "none":
            return ()
        names = self.axes.get("algorithm", [self.algorithm])
        return tuple(name for name in ALGORITHMS if isinstance(names, list) and name in names)

    @property
    def used_depots(self) -> tuple[StudyDepot, ...]:
        """The depots of a study without the axis ``depots``."""
        return self.depot[: self.depots]

    @pydantic.model_validator(mode="after")
    def _check(self) -> "Study":
        check_reward("reward", self.reward)
        check_axes(self)
        _check_traffic(self)
        check_ranges(self.params, "params.")
        _check_drawn(self)
        _check_fleets(self)
        _check_horizon(self)
        _check_algorithms(self)
        if self.algorithm == "none" and not self.evaluation.baselines + self.evaluation.planners:
            raise ValueError(
                "algorithm is 'none' and evaluation has neither baselines nor planners; name one to evaluate"
            )
        return self


def _check_drawn(study: Study) -> None:
    """Check that no other setting determines the scenario."""
    if study.scenarios is None:
        return
    check_scenarios(study.scenarios, study.params.n_devices)
    for name in ("place", "traffic_bonus", "traffic_penalty"):
        if getattr(study, name) or name in study.axes:
            raise ValueError(f"{name} is given, and scenarios too, which draw their own; leave one of them out")


def _check_traffic(study: Study) -> None:
    """Check that traffic settings come with a place."""
    if study.place or "place" in study.axes:
        return
    for name in (*TRAFFIC_WEIGHTS, "place_scale_m"):
        if getattr(study, name) or name in study.axes:
            raise ValueError(f"{name} is given, but no place; give place, e.g. place = 'albany'")


def check_inside(depots: Sequence[StudyDepot], region_m: tuple[float, float], region: str) -> None:
    """Check that every depot is inside a region.

    Raises:
        ValueError: one line that names the depot and the ``region``.
    """
    for number, depot in enumerate(depots, 1):
        position = (depot.x_m, depot.y_m)
        if not all(0 <= at <= side for at, side in zip(position, region_m, strict=True)):
            sides = " x ".join(f"{side:.0f}" for side in region_m)
            raise ValueError(
                f"{label('depot', number, depot.name)}: is at {list(position)}, outside {region}, {sides} m; "
                "give x_m and y_m inside it"
            )


def _check_fleets(study: Study) -> None:
    """Check the depots, and that nothing but evaluation is asked of fleets."""
    if study.depots is not None and study.depots > len(study.depot):
        raise ValueError(f"depots is {study.depots}; {expected_depots(study)}")
    if study.evaluation.clairvoyant_seeds == ():
        raise ValueError("evaluation.clairvoyant_seeds is empty; give a number for one UAV, for two, and so on")
    if study.evaluation.clairvoyant_seeds is not None and study.scenarios is not None:
        raise ValueError(
            "evaluation.clairvoyant_seeds is given, but with [scenarios] all seeds share the held-out scenarios; leave it out"
        )
    check_depots(study.depot)
    if not (study.place or "place" in study.axes):
        check_inside(study.depot, study.params.region_m, "params.region_m")
    there = study.axes.get("depots", [len(study.used_depots)])
    for name, values, least in (("uavs", study.axes.get("uavs", [study.uavs]), 1), ("depots", there, 0)):
        if max(values) == least:
            continue
        where = f"axes.{name} has" if name in study.axes else f"{name} is"
        if study.scenarios is not None:
            raise ValueError(
                f"{where} {max(values)}, and scenarios are given, which have one UAV; leave one of them out"
            )
        if study.algorithms:
            algorithm = study.algorithms[0]
            raise ValueError(
                f"{where} {max(values)}, and algorithm is {algorithm!r}, which trains for one UAV without depots; "
                "set algorithm = 'none'"
            )


def _check_horizon(study: Study) -> None:
    """Check that nothing that knows only lifetimes is asked about episodes that no failure ends."""
    asked = [name for name in study.evaluation.planners if name in CLAIRVOYANT]
    if study.params.end == "horizon" and asked:
        raise ValueError(
            f"evaluation.planners has {asked[0]!r}, which is about the first failure, and params.end is 'horizon'; give "
            "planners = ['rollout'] or []"
        )
    for algorithm in study.algorithms:
        check_end(algorithm, study.params.end, getattr(study, algorithm).observation)


def _check_algorithms(study: Study) -> None:
    """Check that only algorithms of the study have settings, and that the settings of each fit together."""
    for name in ALGORITHMS:
        if name in study.model_fields_set and name not in study.algorithms and study.algorithms:
            raise ValueError(f"{name} has settings, but the study trains {', '.join(study.algorithms)}; leave them out")
    for name in study.algorithms:
        try:
            ALGORITHMS[name].make(
                getattr(study, name).model_dump(), total_steps=study.steps, n_devices=study.params.n_devices, max_age=1
            )
        except ValueError as error:
            raise ValueError(f"{name}.{error}") from None
