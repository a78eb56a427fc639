"""A trained network as one file that says what it needs: shape, pictures, actions, geometry.

It is a safetensors file whose metadata hold a `Bundle`. Other programs read it as plain weights.
"""

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from services.commander import frozen
from shared import provenance, run_record, settings
from shared.config import Config, RobotConfig
from shared.errors import ConfigError, StateError, first_problem
from shared.provenance import BUNDLE, Bundle
from shared.statefile import write_atomically

TOLERANCE = 0.1
"""A robot may go this much farther or less far with an action than where the network learnt."""


def make(run: Path, out: Path) -> Bundle:
    """Write the newest target network of a run folder as a bundle.

    Raises:
        ConfigError: There is no network or no configuration in the folder, or `out` exists.
        StateError: The network or the configuration is damaged.
    """
    if out.exists():
        raise ConfigError(f"--out: {out} exists already")
    found, made = described(run)
    found.predictor(made.network)  # it fits
    write_atomically(out, frozen.packed(found.data, made))
    return made


def described(run: Path) -> tuple[frozen.Frozen, Bundle]:
    """The network of a run, and what it says or its folder tells of it. Raises as `make`."""
    found, made = look(run)
    file = frozen.configuration_of(run)
    if made is None:
        if file is None:
            raise ConfigError(f"run {run}: expected a {settings.FILE_NAME} in it, found none")
        config = settings.read_folder(file.parent)
        made = provenance.bundle(config, episode=found.episode, train_steps=found.train_steps)
    if file is None or not (record := file.parent / run_record.RUN).exists():
        return found, made
    info = run_record.RunInfo.model_validate_json(record.read_bytes())
    told = made.provenance | {"commit": info.commit, "started": info.started}
    return found, made.model_copy(update={"provenance": told})


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
    text = found.metadata.get(BUNDLE)
    if text is None:
        return None
    try:
        bundle = Bundle.model_validate_json(text)
    except ValidationError as error:
        raise StateError(f"{found.path}: damaged bundle: {first_problem(error)}") from error
    for what in ("format", "preprocessing", "image", "actions"):
        here = Bundle.model_fields[what].default
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
