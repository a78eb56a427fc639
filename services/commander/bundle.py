"""A trained network as one file that says what it needs: shape, pictures, actions, geometry.

It is a safetensors file whose metadata hold a `Bundle` as JSON under `bundle`. Other programs read
it as plain weights.
"""

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from services.commander import frozen
from shared import run_record, settings
from shared.config import Config, NetworkConfig, RobotConfig
from shared.errors import ConfigError, StateError, first_problem
from shared.facts import ACTIONS, IMAGE_SHAPE
from shared.rl.preprocess import PREPROCESS_VERSION
from shared.statefile import write_atomically

FORMAT = 1
KEY = "bundle"
TOLERANCE = 0.1
"""A robot may go this much farther or less far with an action than where the network learnt."""


class Bundle(BaseModel):
    """What a network was trained for and by what."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: int
    preprocessing: int
    """`PREPROCESS_VERSION` of its pictures."""
    image: tuple[int, int] = Field(description="Height and width in pixels.")
    actions: tuple[str, ...]
    network: NetworkConfig
    robot: RobotConfig
    """The robot that it learnt on: what an action does, and what the camera sees."""
    provenance: dict[str, str | int | None]


def make(run: Path, out: Path) -> Bundle:
    """Write the newest target network of a run folder as a bundle.

    Raises:
        ConfigError: There is no network or no configuration in the folder, or `out` exists.
        StateError: The network or the configuration is damaged.
    """
    if out.exists():
        raise ConfigError(f"--out: {out} exists already")
    found = frozen.read(frozen.find(run))
    file = frozen.configuration_of(run)
    if file is None:
        raise ConfigError(f"run {run}: expected a {settings.FILE_NAME} in it, found none")
    config = settings.read_folder(file.parent)
    found.predictor(config.network)  # it fits
    bundle = Bundle(
        format=FORMAT,
        preprocessing=PREPROCESS_VERSION,
        image=IMAGE_SHAPE,
        actions=tuple(action.name for action in ACTIONS),
        network=config.network,
        robot=config.robot,
        provenance=_provenance(file.parent, config, found),
    )
    write_atomically(out, found.packed({KEY: bundle.model_dump_json()}))
    return bundle


def look(network: Path) -> tuple[frozen.Frozen, Bundle | None]:
    """The network in a file or in the folder of a run. Raises as `frozen.find`, `read` and `of`."""
    found = frozen.read(frozen.find(network))
    return found, of(found)


def of(found: frozen.Frozen) -> Bundle | None:
    """The bundle that a file of weights is; None: it is a plain one.

    Raises:
        ConfigError: It was made for other pictures or actions than this program has, or by a newer
            program.
        StateError: It cannot be read.
    """
    text = found.metadata.get(KEY)
    if text is None:
        return None
    try:
        bundle = Bundle.model_validate_json(text)
    except ValidationError as error:
        raise StateError(f"{found.path}: damaged bundle: {first_problem(error)}") from error
    for what, here in (
        ("format", FORMAT),
        ("preprocessing", PREPROCESS_VERSION),
        ("image", IMAGE_SHAPE),
        ("actions", tuple(action.name for action in ACTIONS)),
    ):
        there = getattr(bundle, what)
        if there != here:
            raise ConfigError(
                f"{found.path}: its {what} is {_text(there)}, this program has {_text(here)}"
            )
    return bundle


def refuse_misfit(path: Path, bundle: Bundle, robot: RobotConfig) -> None:
    """Raise ConfigError for a robot that does something else with an action, or sees otherwise."""
    for what, unit, learnt, here in (
        ("way of an action", "m", bundle.robot.step_m, robot.step_m),
        ("turn of an action", "radians", bundle.robot.step_rad, robot.step_rad),
        ("height of the camera", "m", bundle.robot.camera.height_m, robot.camera.height_m),
        (
            "vertical view of the camera",
            "degrees",
            bundle.robot.camera.vertical_fov_deg,
            robot.camera.vertical_fov_deg,
        ),
    ):
        if abs(here - learnt) > TOLERANCE * learnt:
            raise ConfigError(
                f"{path}: it learnt with a {what} of {learnt:.3g} {unit}, "
                f"this robot has {here:.3g} {unit}"
            )


def overrides(bundle: Bundle) -> list[str]:
    """The settings of its robot and network, as options of the command line."""
    base = Config()
    told = base.model_copy(update={"network": bundle.network, "robot": bundle.robot})
    return [
        f"{key}={settings.toml_value(value)}" for key, _, value in settings.differences(base, told)
    ]


def _text(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _provenance(folder: Path, config: Config, found: frozen.Frozen) -> dict[str, str | int | None]:
    """Where it comes from, as far as the folder tells."""
    told: dict[str, str | int | None] = {
        "run": config.run.name,
        "world": config.robot.world,
        "seed": config.run.seed,
        "episode": found.episode,
        "train_steps": found.train_steps,
    }
    if (folder / run_record.RUN).exists():
        info = run_record.RunInfo.model_validate_json((folder / run_record.RUN).read_bytes())
        told |= {name: getattr(info, name) for name in ("commit", "started")}
    return told
