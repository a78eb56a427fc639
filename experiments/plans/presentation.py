"""How reports show an experiment: the table `report` of a plan.

Reports know no experiment by name. What is shown together, what is compared with what, and what
the thesis lets one expect stands in the plans.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from shared.config import Name, Section

Names = Annotated[tuple[Name, ...], Field(strict=False)]


class Claim(Section):
    """Something that the thesis says of an experiment, and the figure of a seed that shows it."""

    text: str
    source: str
    """Where the thesis says it."""
    figure: Literal[
        "bumps-beside",
        "rarer-direction",
        "unbalance",
        "lowest-fitness",
        "kept",
        "samples-beside",
        "highest-threshold",
        "highest-capacity",
        "clean-tours",
        "fitness-beside",
        "loss-after-fit",
    ]
    """What is measured: the names of `experiments/report/claims.py`."""
    others: Names = ()
    """Experiments that it is measured beside, with the same seed."""
    stage: str = ""
    """The stage at whose end frozen networks drive; empty: the newest drive."""
    worlds: Names = ()
    """Where they drive, or the corridors whose samples are counted."""
    least: float | None = None
    """The claim holds in a seed whose figure is at least this."""
    most: float | None = None
    """And at most this."""


class Comparison(Section):
    """A comparison with other experiments. It is shown where all of them were run."""

    kind: Literal["continued", "fitness", "equal-actions", "predictions", "kept", "ratios"]
    """continued: fitness of another experiment and of this one, which goes on from it.
    fitness: fitness of all, each from its own first episode.
    equal-actions: bumps beside each other one, after equally many actions of learning.
    predictions: rewards predicted for the same images by this network and another one.
    kept: mean way between bumps in `world` before and after learning in other corridors.
    ratios: bumps beside each other one at the end of every stage, in all corridors, by seed."""
    others: Names = ()
    world: Name = "plus"
    weights: Literal["best", "last"] = "best"
    """Weights of this experiment that predict; those of the other one are always its best."""
    figure: str = ""
    """The figure of the thesis that shows the same, such as "Fig 4.5"."""

    @model_validator(mode="after")
    def _enough_others(self) -> Self:
        least, most = _OTHERS[self.kind]
        if not least <= len(self.others) <= most:
            raise ValueError(f"others: expected {least} to {most} for {self.kind}")
        return self


_OTHERS = {
    "continued": (1, 1),
    "fitness": (1, 7),
    "equal-actions": (1, 20),
    "predictions": (1, 1),
    "kept": (0, 0),
    "ratios": (1, 10),
}
"""Least and most other experiments by kind of comparison."""


class Presentation(Section):
    """The table `report` of a plan."""

    groups: Names = ("runs",)
    """Frozen drives are shown together with those of experiments of the same group that learned
    the same corridors."""
    reference_of: Names = ()
    """Groups in which all others are compared with this experiment only."""
    table: Literal["", "fitness"] = ""
    """The table that this experiment has a row in."""
    figures: dict[str, str] = Field(default_factory=dict)
    """The figure of the thesis by the kind of ours: fitness, loss, memory, worlds, route, table,
    `probes-best-<world>`, `probes-last-<world>`."""
    comparisons: Annotated[tuple[Comparison, ...], Field(strict=False)] = ()
    claims: Annotated[tuple[Claim, ...], Field(strict=False)] = ()


INHERITED = ("groups", "table")
"""What a plan takes over from the one that it is `like`; the rest tells of one experiment only."""
