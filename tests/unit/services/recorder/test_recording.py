"""Recordings: written, cut off, damaged, made by others, and played back (H8)."""

from __future__ import annotations

import contextlib
import json
import math
import re
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import make_observation
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from services.cli import main as cli
from services.recorder import playback
from services.recorder.reader import MAX_CHUNK_BYTES, MAX_RECORD_BYTES, Recording
from services.recorder.recording import Origin, RecordingWriter
from services.recorder.ring import Ring
from services.recorder.service import actor_numerics
from services.recorder.tap import Heard, Version
from services.robot_driver.simulated.world import solids
from shared.codec import encode
from shared.config import ActorNumerics, Config
from shared.errors import ConfigError, StateError
from shared.keys import ACTION, OBSERVATION
from shared.messages import Action, Observation, image_array
from shared.rl.network import initialised, to_bytes
from shared.rl.policy import decide
from shared.rl.predictor import Predictor
from shared.settings import to_toml

FAST = settings(deadline=None, max_examples=60, derandomize=True)
LIFE = "b" * 12
CONFIG = Config.model_validate(
    {
        "run": {"name": "lab", "seed": 5},
        "network": {"filters": 4},
        "memory": {"strategy": "normm"},
        "policy": {"epsilon": 0.5, "temperature": 0.5},
    }
)
NUMERICS = ActorNumerics()
WEIGHTS = {version: to_bytes(initialised(CONFIG.network, seed=version)) for version in (1, 2)}


def heard(message: Observation | Action, time_ns: int = 1) -> Heard:
    stream = OBSERVATION if isinstance(message, Observation) else ACTION
    return Heard(stream, message.robot, time_ns, encode(message))


def chosen(observation: Observation, version: int, step: int, **fields: Any) -> Action:
    """What an actor with these weights chooses, as the actor itself does it."""
    network = Predictor(CONFIG.network, NUMERICS)
    network.load(version, WEIGHTS[version])
    values = network.all_values(image_array(observation.image)[np.newaxis])[0]
    filling = version == 1
    episode = fields.get("fills" if filling else "episode", 0)
    action, by = decide(
        CONFIG, observation.robot, values, filling=filling, episode=episode, step=step
    )
    return Action(
        robot=observation.robot,
        actor_life=LIFE,
        robot_life=observation.life,
        sequence=observation.sequence,
        attempt=observation.attempt,
        action=action,
        by=by,
        values=tuple(values.tolist()),
        weights_version=version,
        filling=filling,
        step=step,
        **fields,
    )


def drive(count: int) -> list[tuple[Observation, Action]]:
    """Some turns: the first half fills the memory, the second is driven by the second weights."""
    turns = []
    for i in range(count):
        observation = make_observation(i)
        version = 1 if i < count // 2 else 2
        fields = {"fills": 3} if version == 1 else {"episode": 7}
        turns.append((observation, chosen(observation, version, step=i, **fields)))
    return turns


def write(path: Path, turns: list[tuple[Observation, Action]], **kwargs: Any) -> Path:
    with RecordingWriter(path, Origin(CONFIG, NUMERICS, **kwargs), solids) as writer:
        for i, (observation, action) in enumerate(turns):
            writer.add(heard(observation, 2 * i))
            writer.add(heard(action, 2 * i + 1))
        for version, data in WEIGHTS.items():
            writer.add(Version(version, 9, data))
        writer.add_summary({"messages": writer.messages, "lost.observation": 0})
    return path


@pytest.fixture(scope="module")
def turns() -> list[tuple[Observation, Action]]:
    return drive(24)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, turns: Any) -> Path:
    return write(tmp_path_factory.mktemp("whole") / "drive.mcap", turns)


# ------------------------------------------------------------------------- form


def test_what_was_written_is_read(whole: Path, turns: list[tuple[Observation, Action]]) -> None:
    recording = Recording(whole)
    assert recording.origin == Origin(CONFIG, NUMERICS)
    assert recording.complete
    assert recording.summary == {"messages": 48, "lost.observation": 0}
    assert list(recording.messages()) == [m for turn in turns for m in turn]
    assert {version: recording.load(version) for version in recording.weights} == WEIGHTS
    assert recording.undecodable == 0


def test_other_tools_read_it(whole: Path, turns: list[tuple[Observation, Action]]) -> None:
    """By the reader of the container's own library, with the schemas that the file brings along."""
    seen: dict[str, list[Any]] = {}
    with whole.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        assert {c.compression for c in summary.chunk_indexes} == {"zstd"}
        topics = {c.topic: c.message_encoding for c in summary.channels.values()}
        plain = {name for name, encoding in topics.items() if encoding != "protobuf"}
        views = topics.keys() - plain
        assert plain - {"/robot1/prediction"} == {
            "lab/robot/robot1/observation",
            "lab/actor/robot1/action",
        }
        for _, channel, _, decoded in reader.iter_decoded_messages(topics=views):
            seen.setdefault(channel.topic, []).append(decoded)
        for _, _, message in reader.iter_messages(topics=["/robot1/prediction"]):
            seen.setdefault("/robot1/prediction", []).append(json.loads(message.data))
    observation, action = turns[7]
    image, pose = seen["/robot1/image"][7], seen["/robot1/pose"][7].pose
    assert (image.width, image.height, image.encoding) == (75, 50, "mono8")
    assert image.data == observation.image
    assert (pose.position.x, pose.position.y) == (observation.x_m, observation.y_m)
    assert 2 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(
        observation.heading_rad
    )
    assert seen["/tf"][7].child_frame_id == "robot1"
    assert seen["/robot1/prediction"][7]["left"] == action.values[1]
    layout = (Path(__file__).parents[4] / "docs/foxglove-layout.json").read_text()
    named = re.findall(r"/(?:robotino1/)?[a-z]+", layout)
    assert {topic.replace("robotino1", "robot1") for topic in named} <= seen.keys()
    (world,) = seen["/world"]
    assert len(world.entities[0].cubes) == len(solids(observation.world)) > 4


def test_nothing_is_overwritten(whole: Path) -> None:
    before = whole.read_bytes()
    with pytest.raises(ConfigError, match="exists already"):
        RecordingWriter(whole, Origin(CONFIG, NUMERICS))
    assert whole.read_bytes() == before


def test_what_was_flushed_survives_a_kill(tmp_path: Path, turns: Any) -> None:
    path = tmp_path / "killed.mcap"
    writer = RecordingWriter(path, Origin(CONFIG, NUMERICS))
    for observation, action in turns[:5]:
        writer.add(heard(observation))
        writer.add(heard(action))
    writer.flush()
    whole_chunks = path.stat().st_size
    writer.add(heard(turns[5][0]))
    writer.flush()
    copy = tmp_path / "copy.mcap"
    for cut in (whole_chunks, whole_chunks + 99):  # killed between two chunks, and within one
        copy.write_bytes(path.read_bytes()[:cut])
        recording = Recording(copy)
        assert not recording.complete
        assert len(list(recording.messages())) == 10
    writer.__exit__(None, None, None)


def test_the_last_seconds_are_kept_with_the_weights_they_need(
    tmp_path: Path, turns: list[tuple[Observation, Action]]
) -> None:
    ring = Ring(last_s=2.0)
    for second, (observation, action) in enumerate(turns[10:16]):
        if second in (0, 1, 2):
            ring.add(Version(second, int(second * 1e9), WEIGHTS[1 + second % 2]))
        ring.add(heard(observation, int(second * 1e9)))
        ring.add(heard(action, int(second * 1e9)))
    path = tmp_path / "last.mcap"
    with RecordingWriter(path, Origin(CONFIG, NUMERICS)) as writer:
        ring.write(writer)
    recording = Recording(path)
    assert list(recording.messages()) == [m for turn in turns[13:16] for m in turn]
    assert set(recording.weights) == {1, 2}
    assert (ring.messages, ring.refused) == (6, 0)


# ------------------------------------------------------------------------- foreign bytes


@FAST
@given(data=st.data())
def test_a_cut_or_changed_file_never_ends_in_a_crash(
    whole: Path, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(whole.read_bytes())
    end = data.draw(st.integers(0, len(content)))
    if data.draw(st.booleans()):
        del content[end:]
    else:
        for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=8)):
            content[place] ^= data.draw(st.integers(1, 255))
    path = tmp_path_factory.mktemp("cut") / "cut.mcap"
    path.write_bytes(content)
    with suppress(StateError):
        recording = Recording(path)
        assert len(list(recording.messages())) <= 48
        for version in recording.weights:
            recording.load(version)


def foreign(path: Path, fill: Callable[[Writer], None], compression: Any = None) -> Path:
    """A file made by somebody else's program."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression or CompressionType.NONE)
        writer.start("corridor")
        about = {"run": "lab", "protocol": "1", "preprocessing": "1"}
        writer.add_metadata("recording", {**about, "numerics.actor": NUMERICS.model_dump_json()})
        writer.add_metadata("config", {"toml": to_toml(CONFIG)})
        fill(writer)
        writer.finish()
    return path


def add(writer: Writer, name: str, topic: str, data: bytes) -> None:
    schema = writer.register_schema(name, "jsonschema", b"{}")
    channel = writer.register_channel(topic, "msgpack", schema)
    writer.add_message(channel, 0, data, 0)


@pytest.mark.parametrize(
    ("name", "topic", "data"),
    [
        ("Observation", "lab/robot/robot1/observation", b""),
        ("Observation", "lab/robot/robot1/observation", bytes(9000)),
        ("Observation", "lab/robot/other/observation", encode(make_observation(1))),
        ("Observation", "lab/robot/*/observation", encode(make_observation(1))),
        ("Observation", "lab/actor/robot1/action", encode(make_observation(1))),
        ("os.system", "lab/robot/robot1/observation", encode(make_observation(1))),
    ],
    ids=["empty", "large", "sender", "wildcard", "key", "name"],
)
def test_what_is_no_message_of_the_protocol_is_left_out_and_counted(
    tmp_path: Path, name: str, topic: str, data: bytes
) -> None:
    path = foreign(tmp_path / "f.mcap", lambda w: add(w, name, topic, data))
    recording = Recording(path)
    assert list(recording.messages()) == []
    assert recording.undecodable == 1


@pytest.mark.parametrize(
    ("compression", "size", "complaint"),
    [
        (CompressionType.LZ4, 100, "expected zstd"),
        (CompressionType.ZSTD, MAX_CHUNK_BYTES, "a chunk of"),
    ],
)
def test_chunks_are_bounded_before_they_are_decompressed(
    tmp_path: Path, compression: CompressionType, size: int, complaint: str
) -> None:
    path = foreign(
        tmp_path / "f.mcap",
        lambda w: add(w, "Observation", "lab/robot/robot1/observation", bytes(size)),
        compression,
    )
    with pytest.raises(StateError, match=complaint):
        list(Recording(path).messages())


def test_a_huge_record_is_refused_before_it_is_read(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    head = whole.read_bytes()[:8] + struct.pack("<BQ", 9, MAX_RECORD_BYTES + 1)
    path.write_bytes(head)
    with path.open("r+b") as file:
        file.truncate(2 * MAX_RECORD_BYTES)  # sparse
    with pytest.raises(StateError, match="exceeds limit"):
        Recording(path)


def test_files_that_are_none_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["playback", str(tmp_path / "none.mcap")]) == 2
    path = tmp_path / "x.mcap"
    path.write_bytes(b"something else")
    assert cli.main(["playback", str(path)]) == 3
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 2
    assert "there is no such file" in said[0]
    assert "not an MCAP file" in said[1]


# ------------------------------------------------------------------------- playback


def test_a_recording_played_back_gives_the_recorded_actions(
    whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["playback", str(whole)]) == 0
    assert "24 of 24 actions equal, 24 of them to the last bit" in capsys.readouterr().out


@pytest.mark.parametrize("change", ["action", "seed", "by"])
def test_a_difference_is_told_and_makes_the_exit_code_1(
    tmp_path: Path, turns: Any, change: str, capsys: pytest.CaptureFixture[str]
) -> None:
    observation, action = turns[20]
    fields: dict[str, Any] = {
        "action": {"action": (action.action + 1) % 3},
        "seed": {"step": action.step + 1, "episode": 11},
        "by": {"by": "chance" if action.by == "network" else "network"},
    }[change]
    other = action.model_copy(update=fields)
    path = write(tmp_path / "f.mcap", [*turns[:20], (observation, other), *turns[21:]])
    code = cli.main(["playback", str(path)])
    said = capsys.readouterr().out
    if code == 0:  # another draw may happen to choose the same
        assert change == "seed"
        return
    assert "23 of 24 actions equal" in said
    assert "first difference: robot 'robot1', sequence 20, weights 2: recorded action" in said


def test_what_cannot_be_compared_is_counted_and_nothing_at_all_is_a_failure(
    tmp_path: Path, turns: Any
) -> None:
    observation, action = turns[20]
    others = [
        action.model_copy(update={"action": None}),
        action.model_copy(update={"weights_version": 0}),
        action.model_copy(update={"weights_version": 99}),
        action.model_copy(update={"sequence": 999}),
    ]
    path = write(tmp_path / "f.mcap", [(observation, other) for other in others])
    found = playback.compare(Recording(path))
    assert (found.equal, found.different, found.passed) == (0, 0, False)
    assert sorted(found.skipped.values()) == [1, 1, 1, 1]


@pytest.mark.parametrize("what", ["protocol", "preprocessing"])
def test_recordings_of_other_versions_are_refused(tmp_path: Path, turns: Any, what: str) -> None:
    path = write(tmp_path / "f.mcap", turns[:2], **{what: 99})
    with pytest.raises(ConfigError, match=f"{what} 99"):
        playback.compare(Recording(path))


def test_damaged_weights_are_refused(tmp_path: Path, turns: Any) -> None:
    path = tmp_path / "f.mcap"
    with RecordingWriter(path, Origin(CONFIG, NUMERICS)) as writer:
        writer.add(heard(turns[20][0]))
        writer.add(heard(turns[20][1]))
        writer.add(Version(2, 0, WEIGHTS[2][:-8]))
    with pytest.raises(StateError, match="recorded weights of version 2"):
        playback.compare(Recording(path))


def test_weights_that_changed_on_disk_are_refused(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    data[data.index(WEIGHTS[2]) + len(WEIGHTS[2]) - 5] ^= 1
    path = tmp_path / "f.mcap"
    path.write_bytes(data)
    recording = Recording(path)
    assert recording.load(1) == WEIGHTS[1]
    with pytest.raises(StateError, match="weights 2 do not match their checksum"):
        recording.load(2)


def test_lengths_that_no_file_has_are_refused(whole: Path, tmp_path: Path) -> None:
    data = bytearray(whole.read_bytes())
    length = data.index(WEIGHTS[1]) - 8
    data[length : length + 8] = (2**63).to_bytes(8, "little")
    path = tmp_path / "f.mcap"
    path.write_bytes(data)
    with pytest.raises(StateError, match="damaged"):
        Recording(path)


def test_a_recording_that_failed_does_not_look_complete(tmp_path: Path, turns: Any) -> None:
    path = tmp_path / "f.mcap"
    with contextlib.suppress(OSError), RecordingWriter(path, Origin(CONFIG, NUMERICS)) as writer:
        writer.add(heard(turns[0][0]))
        writer.flush()
        raise OSError("full")
    recording = Recording(path)
    assert not recording.complete
    assert len(list(recording.messages())) == 1


def test_numerics_come_from_the_run_folder(tmp_path: Path) -> None:
    open_ones = Config.model_validate({"numerics": {"actor": {"engine": "auto"}}})
    with pytest.raises(ConfigError, match="record beside the run"):
        actor_numerics(open_ones, tmp_path)
    (tmp_path / "numerics").mkdir()
    (tmp_path / "numerics" / "actor.json").write_text(NUMERICS.model_dump_json())
    assert actor_numerics(open_ones, tmp_path) == NUMERICS
    assert actor_numerics(CONFIG, tmp_path / "nowhere") == CONFIG.numerics.actor
