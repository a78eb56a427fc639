"""`corridor video`: a film of a recording, or of a drive with the frozen network of a run."""

from collections.abc import Iterator
from pathlib import Path

from experiments.drives.frozen_drives import Drive
from experiments.drives.places import first_start
from experiments.environment import CorridorEnv, with_world
from services.commander import bundle
from services.extras import import_installed
from services.robot_driver.atlas.film import MAX_GIF_FRAMES, filming
from shared.config import Config
from shared.errors import ConfigError
from shared.messages import Action, Observation, image_array
from shared.rl.draws import generator
from shared.rl.policy import choose_greedily


def run(source: Path, out: Path, world: str | None, frames: int, parts: int, speed: float) -> str:
    """Film a recording (`.mcap`), or the network of a run in a world; returns a line about it.

    A recording is shown in so many parts, spread evenly over all of it; one frame is one action.
    Raises ConfigError or StateError where there is no such source, or it or the file is unfit.
    """
    if out.suffix == ".gif":
        frames = min(frames, MAX_GIF_FRAMES)
    if source.suffix == ".mcap":
        _film_recording(source, out, frames, parts, speed)
    else:
        _film_drive(source, out, world, frames, speed)
    return f"{out}: {out.stat().st_size / 1e6:.1f} MB"


def _film_recording(source: Path, out: Path, frames: int, parts: int, speed: float) -> None:
    recording = import_installed("services.recorder.reader", "record").Recording(source)
    robot = next((action.robot for _, action in recording.turns()), "")

    def turns() -> Iterator[tuple[Observation, Action]]:
        mine = (turn for turn in recording.turns() if turn[1].robot == robot)
        return ((seen, action) for seen, action in mine if seen is not None)

    total = sum(1 for _ in turns())
    each = min(frames // parts, total // parts)
    if not each:
        raise ConfigError(f"{source}: {total} actions with their observations, for {parts} parts")
    begins = [round(part * (total - each) / max(parts - 1, 1)) for part in range(parts)]
    with filming(out, speed / recording.origin.config.robot.period_s) as film:
        for number, (seen, action) in enumerate(turns()):
            if any(begin <= number < begin + each for begin in begins):
                when = "filling" if action.filling else f"episode {action.episode}"
                film.add(seen, action.values, action.action, f"action {number + 1:,}  {when}")


def _film_drive(source: Path, out: Path, world: str | None, frames: int, speed: float) -> None:
    found, made = bundle.described(source)
    config = Config(network=made.network, robot=made.robot.model_copy(update={"kind": "sim"}))
    config = with_world(config, world or str(made.provenance["world"]))
    network, draw = found.predictor(made.network), generator(0, "video")
    with CorridorEnv(config=config) as env, filming(out, speed / config.robot.period_s) as film:
        drive = Drive(env, 0, first_start(env.world))
        for number in range(frames):
            seen = drive.observation
            values = network.all_values(image_array(seen.image)[None])[0]
            action = choose_greedily(values, draw)
            film.add(seen, values.tolist(), action, f"action {number + 1:,}")
            drive.act(action)
