"""Messages to bytes and back; every kind of bad bytes is a BadMessage and nothing else (B6)."""

from __future__ import annotations

import math
import random
import tracemalloc
from typing import Annotated, Any, Literal, get_args, get_origin

import msgpack
import numpy as np
import pytest
from builders import make_episode, make_images, make_observation
from fakes import message
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pydantic.fields import FieldInfo

from shared import messages as m
from shared.codec import decode, encode
from shared.errors import BadMessage
from shared.keys import STREAMS

FAST = settings(
    deadline=None,
    max_examples=40,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
CLASSES = sorted(
    {
        cls
        for cls in vars(m).values()
        if isinstance(cls, type) and issubclass(cls, m.Message) and cls is not m.Message
    },
    key=lambda cls: cls.__name__,
)
NAMES = [cls.__name__ for cls in CLASSES]


# ------------------------------------------------------------------------- made-up messages


def limits_of(metadata: Any) -> dict[str, Any]:
    found = {}
    for item in metadata:
        if isinstance(item, FieldInfo):
            found.update(limits_of(item.metadata))
        for name in ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern"):
            if getattr(item, name, None) is not None:
                found[name] = getattr(item, name)
    return found


def values_of(annotation: Any, limits: dict[str, Any]) -> st.SearchStrategy[Any]:
    """Valid values of a field, from its annotation alone."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return values_of(arguments[0], limits_of(arguments[1:]))
    if origin is Literal:
        return st.sampled_from(arguments)
    if origin is tuple:
        parts = [values_of(a, {}) for a in arguments if a is not Ellipsis]
        if Ellipsis in arguments:
            least, most = limits.get("min_length", 0), min(limits.get("max_length", 3), 3)
            return st.lists(parts[0], min_size=least, max_size=most).map(tuple)
        return st.tuples(*parts)
    if arguments:  # a union with None
        return st.one_of(
            *(st.none() if a is type(None) else values_of(a, limits) for a in arguments)
        )
    if annotation is bool:
        return st.booleans()
    if annotation is int:
        highest = min(limits.get("le", 2**63 - 1), limits.get("lt", 2**63) - 1)
        return st.integers(limits.get("ge", -(2**63)), highest)
    if annotation is float:
        lowest, highest = limits.get("ge", limits.get("gt")), limits.get("le")
        return st.floats(
            lowest, highest, exclude_min="gt" in limits, allow_nan=False, allow_infinity=False
        )
    if annotation is str:
        if "pattern" in limits:
            return st.from_regex(limits["pattern"].rstrip("$"), fullmatch=True)
        return st.text(max_size=20)
    if annotation is bytes:
        return st.binary(
            min_size=limits.get("min_length", 0), max_size=limits.get("max_length", 40)
        )
    return made_up(annotation)


@st.composite
def episodes(draw: st.DrawFn) -> m.Episode:
    fields: dict[str, Any] = {
        name: draw(values_of(f.annotation, limits_of(f.metadata)))
        for name, f in m.Episode.model_fields.items()
        if f.annotation is not bytes and not name.startswith(("sample_", "worlds"))
    }
    fields["worlds"] = ("plus", "minus")
    fields["bump"] = fields["ended"] == "bump"
    return make_episode(draw(st.integers(1, 3)), seed=draw(st.integers(0, 99)), **fields)


@st.composite
def changes(draw: st.DrawFn) -> m.Change:
    n, kind = draw(st.integers(0, 3)), draw(st.sampled_from(["append", "discard", "rewards"]))
    arrays: dict[str, bytes] = {"ids": np.arange(n).astype("<u8").tobytes()}
    if kind == "append":
        arrays["images"], arrays["actions"] = make_images(n).tobytes(), bytes(n)
    if kind != "discard":
        arrays["rewards"] = np.linspace(-1, 1, n).astype("<f4").tobytes()
    number, last = draw(st.integers(0, 2**63 - 1)), draw(st.booleans())
    return m.Change(number=number, last=last, kind=kind, **arrays)  # type: ignore[arg-type]


@st.composite
def world_changes(draw: st.DrawFn) -> m.WorldChange:
    names = values_of(str, {"pattern": "^[a-z0-9][a-z0-9_-]{0,40}$"})
    kind = draw(st.sampled_from(["switch", "place", "remove"]))
    what: dict[str, Any] = {
        "switch": {"world": draw(names), "start": draw(st.integers(0, 2**31 - 1))},
        "place": {"box": draw(made_up(m.Box))},
        "remove": {"name": draw(names)},
    }[kind]
    number, ident = draw(st.integers(0, 2**63 - 1)), draw(st.sampled_from(["", "0" * 12]))
    return m.WorldChange(kind=kind, id=ident, at_episode=number, **what)  # type: ignore[arg-type]


def made_up(cls: type[m.Message]) -> st.SearchStrategy[Any]:
    if cls is m.Episode:
        return episodes()
    if cls is m.Change:
        return changes()
    if cls is m.WorldChange:
        return world_changes()
    fields = {
        name: values_of(field.annotation, limits_of(field.metadata))
        for name, field in cls.model_fields.items()
    }
    if cls is m.Action:
        fields["action"] = st.none()
    if "image" in fields:
        fields["image"] = st.integers(0, 9).map(lambda seed: make_images(1, seed).tobytes())
    return st.fixed_dictionaries(fields).map(lambda given_fields: cls(**given_fields))


def plain(cls: type[m.Message]) -> m.Message:
    if cls is m.Episode:
        return make_episode(2)
    if cls is m.Observation:
        return make_observation(4)
    if cls is m.Turns:
        return m.Turns(turns=(message(m.Turn), message(m.Turn)))
    given: dict[type[m.Message], dict[str, Any]] = {
        m.MiniBatchRequest: {"size": 1},
        m.Weights: {"parts": 1},
        m.WorldChange: {"world": "plus"},
        m.Release: {"numbers": (1,)},
    }
    return message(cls, **given.get(cls, {}))


def fields_of(some: m.Message) -> dict[str, Any]:
    fields: dict[str, Any] = msgpack.unpackb(encode(some))
    return fields


def refused(fields: Any, cls: type[m.Message]) -> str:
    """The complaint; fails the test if there is none, or if it is long or has several lines."""
    data = fields if isinstance(fields, bytes) else msgpack.packb(fields)
    with pytest.raises(BadMessage) as caught:
        decode(data, cls)
    text = str(caught.value)
    assert cls.__name__ in text
    assert len(text) < 400
    assert "\n" not in text
    return text


def complaint(data: bytes, cls: type[m.Message]) -> str:
    """Why the bytes are refused; empty if they are a valid message."""
    try:
        assert isinstance(decode(data, cls), cls)
    except BadMessage as error:
        return str(error)
    return ""


# ------------------------------------------------------------------------- round trip


@pytest.mark.parametrize("cls", CLASSES, ids=NAMES)
@FAST
@given(data=st.data())
def test_every_message_survives_the_way_through_bytes(
    cls: type[m.Message], data: st.DataObject
) -> None:
    some = data.draw(made_up(cls))
    encoded = encode(some)
    again = decode(encoded, cls)
    assert again == some
    assert type(again) is cls
    assert encode(again) == encoded


@pytest.mark.parametrize("cls", CLASSES, ids=NAMES)
def test_bytes_are_a_map_with_version_and_type_first(cls: type[m.Message]) -> None:
    fields = fields_of(plain(cls))
    assert list(fields)[:2] == ["v", "t"]
    assert (fields.pop("v"), fields.pop("t")) == (m.PROTOCOL_VERSION, cls.__name__)
    assert list(fields) == list(cls.model_fields)


@pytest.mark.parametrize(
    ("some", "golden"),
    [
        (m.WeightsRequest(), b"\x82\xa1v\x03\xa1t\xaeWeightsRequest"),
        (
            m.Refusal(final=True, reason="no"),
            b"\x84\xa1v\x03\xa1t\xa7Refusal\xa5final\xc3\xa6reason\xa2no",
        ),
        (
            m.TurnsRequest(since=300, limit=5),
            b"\x84\xa1v\x03\xa1t\xacTurnsRequest\xa5since\xcd\x01\x2c\xa5limit\x05",
        ),
        (
            m.Action(
                robot="r1",
                actor_life="0123456789ab",
                robot_life="ba9876543210",
                sequence=7,
                attempt=1,
                action=None,
                by="network",
                values=(0.0, -1.0, 0.5),
                weights_version=3,
                motion="turn-left",
                episode=5,
                filling=True,
                fills=2,
                step=9,
            ),
            b"\xde\x00\x10\xa1v\x03\xa1t\xa6Action\xa5robot\xa2r1\xaaactor_life\xac0123456789ab"
            b"\xaarobot_life\xacba9876543210\xa8sequence\x07\xa7attempt\x01\xa6action\xc0"
            b"\xa6motion\xa9turn-left\xa2by\xa7network\xa6values\x93\xcb\x00\x00\x00\x00\x00\x00\x00\x00"
            b"\xcb\xbf\xf0\x00\x00\x00\x00\x00\x00\xcb\x3f\xe0\x00\x00\x00\x00\x00\x00"
            b"\xafweights_version\x03\xa7episode\x05\xa7filling\xc3\xa5fills\x02\xa4step\x09",
        ),
        (
            m.Change(number=2, last=True, kind="discard", ids=b"\x09" + bytes(7)),
            b"\x89\xa1v\x03\xa1t\xa6Change\xa6number\x02\xa4last\xc3\xa4kind\xa7discard"
            b"\xa3ids\xc4\x08\x09\x00\x00\x00\x00\x00\x00\x00\xa6images\xc4\x00"
            b"\xa7actions\xc4\x00\xa7rewards\xc4\x00",
        ),
    ],
    ids=lambda value: type(value).__name__,
)
def test_bytes_stay_what_other_languages_were_told(some: m.Message, golden: bytes) -> None:
    assert encode(some) == golden
    assert decode(golden, type(some)) == some


def test_fields_may_come_in_any_order_and_defaults_may_be_left_out() -> None:
    fields = {"since": 4, "t": "TurnsRequest", "v": m.PROTOCOL_VERSION}
    assert decode(msgpack.packb(fields), m.TurnsRequest) == m.TurnsRequest(since=4, limit=100)


def test_one_of_several_types_is_told_by_its_name() -> None:
    end = m.FeedEnd(change=1, rows=2, messages=3, lineage="0" * 16)
    assert decode(encode(end), m.Change, m.FeedEnd) == end
    with pytest.raises(BadMessage, match="Change or FeedEnd"):
        decode(encode(m.WeightsRequest()), m.Change, m.FeedEnd)


# ------------------------------------------------------------------------- not a message at all


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x80",
        b"\x00",
        b"\x93\x01\x02\x03",
        b"\x81\xa1v",
        b"not msgpack at all, only text",
        b"\x80\x04\x95pickle",
        encode(m.WeightsRequest()) + b"\x00",
        encode(m.WeightsRequest())[:-1],
        b"\xdd\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xc9\xff\xff\xff\xff\x00",
        b"\xdf\x7f\xff\xff\xff\xa1v\x03",
        b"\x82\xa1v\x03\x01\x02",
        b"\x81\xa2\xff\xfe\x01",
        b"\xd6\xff" + b"\xff" * 4,
        b"\xc7\x0c\xff" + b"\xff" * 12,
        b"\xd4\x05a",
        b"\x91" * 600 + b"\x00",
        b"\x91" * 1000 + b"\x00",
        b"\x91" * 200_000 + b"\x00",
        b"\x81\xa1a" * 50_000 + b"\x00",
    ],
    ids=lambda data: data[:6].hex() or "empty",
)
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    for cls in (m.WeightsRequest, m.Observation):
        refused(data, cls)


@FAST
@given(data=st.binary(max_size=300))
@example(b"\x82\xa1v\x03\xa1t\xc0")
def test_random_bytes_are_refused(data: bytes) -> None:
    refused(data, m.Observation)


@pytest.mark.parametrize("cls", CLASSES, ids=NAMES)
def test_damaged_bytes_of_a_message_are_a_valid_message_or_refused(cls: type[m.Message]) -> None:
    good, rng = encode(plain(cls)), random.Random(1)
    for _ in range(150):
        data = bytearray(good)
        for _ in range(rng.randint(1, 3)):
            data[rng.randrange(min(len(data), 400))] = rng.randrange(256)
        if rng.random() < 0.2:
            del data[rng.randrange(len(data)) :]
        assert "\n" not in complaint(bytes(data), cls)


@pytest.mark.parametrize("depth", [1, 50, 500, 990, 1000, 1015, 1023, 1024, 5000])
@pytest.mark.parametrize("place", ["v", "t", "field"])
def test_deep_nesting_is_refused_wherever_it_hides(depth: int, place: str) -> None:
    deep = b"\x91" * depth + b"\x00"
    version = deep if place == "v" else b"\x02"
    name = deep if place == "t" else b"\xaeWeightsRequest"
    more = b"\xa1x" + deep if place == "field" else b"\xa1x\x00"
    refused(b"\x83\xa1v" + version + b"\xa1t" + name + more, m.WeightsRequest)


# ------------------------------------------------------------------------- version and type


@pytest.mark.parametrize(
    "version", [0, 2, 4, -1, None, "3", b"3", True, 3.0, (3,), 2**63, "x" * 4096]
)
def test_another_protocol_version_is_refused(version: Any) -> None:
    text = refused({**fields_of(m.WeightsRequest()), "v": version}, m.WeightsRequest)
    assert f"of protocol {m.PROTOCOL_VERSION}" in text


def test_a_message_without_version_or_type_is_refused() -> None:
    assert "None" in refused({"t": "WeightsRequest"}, m.WeightsRequest)
    assert "None" in refused({"v": m.PROTOCOL_VERSION}, m.WeightsRequest)


@pytest.mark.parametrize(
    "name", ["Action", "Message", "", "observation", None, 5, ("a",), "x" * 4096, "a\nb", "__v"]
)
def test_another_type_is_refused(name: Any) -> None:
    assert "got type" in refused({**fields_of(make_observation(1)), "t": name}, m.Observation)


# ------------------------------------------------------------------------- fields


@pytest.mark.parametrize("cls", CLASSES, ids=NAMES)
def test_missing_and_unknown_fields_are_refused_by_name(cls: type[m.Message]) -> None:
    fields = fields_of(plain(cls))
    for name, field in cls.model_fields.items():
        if field.is_required():
            fewer = {k: v for k, v in fields.items() if k != name}
            assert f"{name}: Field required" in refused(fewer, cls)
    assert "surplus" in refused({**fields, "surplus": 1}, cls)
    refused({**fields, b"bytes": 1}, cls)
    refused({**fields, "x" * 100_000: 1}, cls)
    refused({**fields, "new\nline": 1}, cls)


@pytest.mark.parametrize("cls", CLASSES, ids=NAMES)
def test_a_value_of_another_type_is_refused_in_every_field(cls: type[m.Message]) -> None:
    fields = fields_of(plain(cls))
    for name, field in cls.model_fields.items():
        accepted = str(field.annotation)
        wrong: list[Any] = [{"a": 1}, 1 << 63, "\x00", b"\xff\xfe\xfd"]
        if "float" in accepted:
            wrong += [math.nan, math.inf, -math.inf, True]
            wrong.remove(1 << 63)  # a whole number may stand for a float
        else:
            wrong += [1.0, 0.5]
        if "int" in accepted:
            wrong += [True, False]
        if "bool" in accepted:
            wrong += [0, 1]
        if "bytes" in accepted:
            wrong += ["", "text", [1, 2]]
        for value in wrong:
            text = complaint(msgpack.packb({**fields, name: value}), cls)
            limits = limits_of(field.metadata).keys()
            free = accepted in ("<class 'str'>", "<class 'bytes'>") and limits <= {"max_length"}
            assert name in text or (free and type(value).__name__ in accepted), (name, value)


@pytest.mark.parametrize("value", [-1, 2**63, 2**64 - 1, True, 1.0, "1", None])
def test_counts_are_whole_and_bounded(value: Any) -> None:
    refused({**fields_of(make_observation(1)), "sequence": value}, m.Observation)


@pytest.mark.parametrize("action", [-1, 3, True, 0.0, "0"])
def test_unknown_actions_are_refused(action: Any) -> None:
    refused({**fields_of(message(m.Action)), "action": action}, m.Action)


@pytest.mark.parametrize(
    "name", ["", "-a", "A", "a/b", "*", "a*", "$x", "a b", "ä", "a" * 42, "a\n"]
)
def test_names_that_could_widen_a_key_are_refused(name: str) -> None:
    refused({**fields_of(make_observation(1)), "robot": name}, m.Observation)
    refused({**fields_of(make_observation(1)), "world": name}, m.Observation)


@pytest.mark.parametrize("life", ["", "0" * 11, "0" * 13, "A" * 12, "g" * 12, "0" * 12 + "\n"])
def test_malformed_lives_are_refused(life: str) -> None:
    refused({**fields_of(make_observation(1)), "life": life}, m.Observation)


@pytest.mark.parametrize("size", [0, 3749, 3751, 1_000_000])
def test_an_image_of_another_size_is_refused(size: int) -> None:
    refused({**fields_of(make_observation(1)), "image": bytes(size)}, m.Observation)


@pytest.mark.parametrize(
    "values", [[], [0.0] * 2, [0.0] * 4, [0.0, 0.0, math.nan], [0.0, 0.0, "0"]]
)
def test_wrongly_sized_or_typed_arrays_are_refused(values: list[Any]) -> None:
    refused({**fields_of(message(m.Action)), "values": values}, m.Action)


# ------------------------------------------------------------------------- episodes and changes

ARRAYS = ["images", "sample_actions", "sample_rewards", "sample_steps", "sample_episodes"]
ARRAYS += ["sample_versions", "sample_worlds", "sample_by", "positions"]


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("change", [-1, 1])
def test_an_episode_whose_arrays_differ_in_length_is_refused(name: str, change: int) -> None:
    fields = fields_of(make_episode(3))
    fields[name] = fields[name][:-1] if change < 0 else fields[name] + b"\x00"
    refused(fields, m.Episode)


def test_an_episode_has_1_to_5000_samples() -> None:
    widths = dict(zip(ARRAYS, (3750, 1, 4, 4, 4, 4, 1, 1, 12), strict=True))
    fields = fields_of(make_episode(1))
    refused({**fields, **dict.fromkeys(ARRAYS, b"")}, m.Episode)
    refused({**fields, **{name: bytes(5001 * width) for name, width in widths.items()}}, m.Episode)
    most = {**fields, **{name: bytes(5000 * width) for name, width in widths.items()}}
    assert decode(msgpack.packb(most), m.Episode).count == 5000


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sample_actions", b"\x00\x03"),
        ("sample_worlds", b"\x00\x01"),
        ("sample_by", b"\x00\x03"),
        ("worlds", []),
        ("worlds", ["a"] * 65),
        ("worlds", ["a/b"]),
        ("sample_rewards", np.array([0.0, 1.01], "<f4").tobytes()),
        ("sample_rewards", np.array([0.0, np.nan], "<f4").tobytes()),
        ("sample_rewards", np.array([-np.inf, 0.0], "<f4").tobytes()),
        ("positions", np.array([0, 0, np.nan, 0, 0, 0], "<f4").tobytes()),
        ("positions", np.array([0, np.inf, 0, 0, 0, 0], "<f4").tobytes()),
        ("actions", 2**31),
        ("fitness", 2**62),
        ("dropped_samples", 2**40),
        ("dropped_episodes", 2**31),
        ("laps_left", 2**31),
        ("ended", "crashed"),
        ("last_sequence", -1),
    ],
)
def test_an_episode_with_impossible_contents_is_refused(name: str, value: Any) -> None:
    refused({**fields_of(make_episode(2)), name: value}, m.Episode)


def test_equal_episodes_have_equal_digests_and_others_do_not() -> None:
    one = make_episode(3, seed=1)
    assert one.digest == make_episode(3, seed=1, life="c" * 12).digest
    assert len(one.digest) == 16
    for name in ("images", "sample_actions", "sample_rewards", "positions"):
        data = bytearray(getattr(one, name))
        data[0] ^= 1
        assert one.model_copy(update={name: bytes(data)}).digest != one.digest


@pytest.mark.parametrize(
    "wrong",
    [
        {"ids": bytes(7)},
        {"kind": "append", "ids": bytes(8)},
        {"kind": "append", "ids": bytes(8), "images": bytes(3750), "actions": b"\x00"},
        {"kind": "append", "ids": b"", "images": bytes(3750), "actions": b"", "rewards": b""},
        {"kind": "discard", "ids": bytes(8), "rewards": bytes(4)},
        {"kind": "rewards", "ids": bytes(16), "rewards": bytes(4)},
        {"kind": "rewards", "ids": bytes(8), "rewards": bytes(4), "actions": b"\x00"},
        {"kind": "replace"},
    ],
)
def test_a_change_whose_arrays_do_not_fit_its_kind_is_refused(wrong: dict[str, Any]) -> None:
    good = fields_of(m.Change(number=1, last=True, kind="discard", ids=b""))
    refused({**good, **wrong}, m.Change)


# ------------------------------------------------------------------------- the messages themselves


def test_messages_are_frozen() -> None:
    with pytest.raises(ValueError, match="frozen"):
        m.WeightsRequest().v = 1  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="frozen"):
        m.TurnsRequest(since=1).since = 2  # type: ignore[misc]


def test_images_are_read_only_views() -> None:
    image = m.image_array(make_observation(3).image)
    assert (image.shape, image.dtype, image.flags.writeable) == ((50, 75), np.uint8, False)


def test_the_largest_message_of_each_stream_fits_its_limit() -> None:
    """An episode of the thesis's 500 samples fits; a foreign one of 5,000 would too."""
    limits = {stream.request: stream.max_bytes for stream in STREAMS}
    assert len(encode(make_episode(500))) < limits[m.Episode]
    assert limits[m.Episode] > 5000 * (3750 + 30)
    assert (
        len(encode(make_observation(2**31, robot="a" * 41, world="a" * 41))) < limits[m.Observation]
    )


@pytest.mark.parametrize(
    ("ended", "bump"), [("bump", False), ("full", True), ("interrupted", True)]
)
def test_episode_that_contradicts_itself_about_its_end_is_refused(ended: str, bump: bool) -> None:
    fields = {**make_episode(2).model_dump(), "ended": ended, "bump": bump}
    with pytest.raises(ValueError, match="but the episode ended"):
        m.Episode(**fields)


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"kind": "switch"}, "switch: expected world and no other, got neither"),
        ({"kind": "switch", "name": "a"}, "switch: expected world and no other, got name"),
        ({"kind": "remove", "name": "a", "world": "plus"}, "remove: expected name and no other"),
        ({"kind": "place", "name": "a"}, "place: expected box and no other"),
        ({"kind": "place", "box": {"name": "a"}}, "box.x_m: Field required"),
        ({"kind": "remove", "name": "a", "at_episode": -1}, "at_episode: "),
        ({"kind": "remove", "name": "a", "id": "1"}, "id: "),
        ({"kind": "remove", "name": "A b"}, "name: "),
        ({"kind": "burn", "name": "a"}, "kind: "),
    ],
)
def test_a_change_of_the_world_names_exactly_what_its_kind_needs(
    fields: dict[str, Any], complaint: str
) -> None:
    assert complaint in refused(
        {"v": m.PROTOCOL_VERSION, "t": "WorldChange", **fields}, m.WorldChange
    )


# ------------------------------------------------------------------------- what it may cost

MIB = 1024 * 1024


def nested(depth: int, width: int, inner: bytes) -> bytes:
    """Arrays of `width` arrays, `depth` deep."""
    return inner if not depth else array(width) + nested(depth - 1, width, inner) * width


def array(length: int) -> bytes:
    return b"\xdd" + length.to_bytes(4, "big")


GREEDY = {
    "empty maps": array(24 * MIB) + b"\x80" * (24 * MIB),
    "empty arrays": array(24 * MIB) + b"\x90" * (24 * MIB),
    "numbers": array(5 * MIB) + b"\xce\xff\xff\xff\xff" * (5 * MIB - 1),
    "arrays of arrays": nested(3, 250, b"\x80"),
    "as a field": b"\x82\xa1v\x03\xa1t" + nested(3, 250, b"\x90"),
    "arrays announced inside arrays": array(2**31) * 900,
    "a map of many": b"\xdf\x00\x40\x00\x00" + b"\xa1a\x80" * (4 * MIB),
    "long names": b"\x81\xdb" + (20 * MIB).to_bytes(4, "big") + b"\xf0\x9f\x98\x80" * (5 * MIB),
    "an extension": b"\x81\xa1v\xc9" + (20 * MIB).to_bytes(4, "big") + b"\x05" + bytes(20 * MIB),
}


@pytest.mark.parametrize("name", GREEDY)
def test_no_message_takes_much_more_memory_than_its_bytes(name: str) -> None:
    """24 MiB of empty maps would be 1.6 GB of them."""
    data = GREEDY[name]
    assert len(data) <= 25 * MIB
    tracemalloc.start()
    try:
        refused(data, m.Episode)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 4 * MIB + 2 * len(data)
    if name not in ("an extension", "long names"):
        assert most < 16 * MIB


def test_the_largest_messages_are_within_the_limits() -> None:
    turn, told = message(m.Turn), m.Told(name="x" * 64, value=1)
    turns = m.Turns(turns=(turn,) * 1000)
    state = message(m.ReplayState, by_action=(1, 2, 3), retention=(told,) * 64)
    ack = m.EpisodeAck(accepted=False, reason="\N{GRINNING FACE}" * 1000)
    for some in (turns, state, ack, make_episode(5000, worlds=tuple(f"w{i}" for i in range(64)))):
        assert decode(encode(some), type(some)) == some


@pytest.mark.parametrize(
    ("cls", "field", "value"),
    [
        (m.Episode, "weights_version", 2**32),
        (m.Episode, "positions", np.array([1e7, 0, 0], "<f4").tobytes()),
        (m.EpisodeAck, "reason", "x" * 1001),
        (m.RobotProgress, "robot_episodes", 2**32),
        (m.RobotProgress, "robot_fills", 2**32),
        (m.RobotProgress, "robot_life", "x"),
        (m.Told, "name", "x" * 65),
        (m.ReplayState, "known_version", 2**32),
        (m.ReplayState, "fitness_mean_100", 1e300),
        (m.ReplayState, "fitness_mean_100", -1.0),
        (m.ReplayState, "lineage", "x" * 16),
        (m.Turn, "lineage", "0" * 15),
        (m.LearnerState, "weights_version", 2**32),
        (m.LearnerState, "loss", -0.5),
        (m.LearnerState, "loss", 1e39),
        (m.Weights, "version", 2**32),
        (m.Weights, "part", 64),
        (m.Weights, "data", bytes(4 * MIB + 1)),
    ],
)
def test_values_beyond_what_is_possible_are_refused(
    cls: type[m.Message], field: str, value: Any
) -> None:
    good = make_episode(1) if cls is m.Episode else plain(cls)
    assert field in refused({**fields_of(good), field: value}, cls)
