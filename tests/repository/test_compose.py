"""Images and compose files fit the code: roles, settings, health checks."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
import zenoh
from builders import LIFE, make_episode
from fakes import fake_service, message

from services import processes
from services.cli.main import main
from services.monitor import health
from services.processes import DRIVER, PROCESSES
from services.replay.storage import Storage
from services.security.authority import Authority
from shared import settings
from shared.bus import Bus
from shared.config import BusConfig, Config, RunConfig
from shared.keys import ACTOR_STATE, LEARNER_STATE, REPLAY_STATE, ROBOT_STATE, Stream
from shared.messages import ActorState, LearnerState, Message, ReplayState, RobotState
from tests.compose.trial import Failed, Trial

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
ROLES = [process.name for process in processes.SERVICES]
DRIVERS = dict(zip(DRIVER.extras, DRIVER.images, strict=True))
"""Image of each kind of robot."""
IMAGE_OF = {"driver": "driver-sim"}
"""Stage of the image of a service, where it has another name."""
SERVICES = [image for process in processes.SERVICES for image in process.images]
IMAGES = ["router", *SERVICES]
FOREIGN = {
    "pybullet": "pybullet",
    "opencv-python-headless": "cv2",
    "pillow": "PIL",
    "simplejpeg": "simplejpeg",
    "rosbags": "rosbags",
    "openvino": "openvino",
    "torch": "torch",
    "safetensors": "safetensors",
    "lmdb": "lmdb",
    "tensorboard": "tensorboard",
    "cryptography": "cryptography",
}
"""Distributions that not every image holds, and what they are imported as."""
MODULES = {
    "router": "services.router.service, services.monitor.health, services.monitor.status, "
    "services.security.router_file",
    "driver-sim": "services.robot_driver.service, services.robot_driver.simulated.sim, "
    "services.monitor.health",
    "driver-robotino": "services.robot_driver.service, services.robot_driver.real.hardware, "
    "services.robot_driver.real.robotino, services.monitor.health",
    "driver-ros2": "services.robot_driver.service, services.robot_driver.real.hardware, "
    "services.robot_driver.real.ros2, services.monitor.health",
    "actor": "services.actor.service, services.monitor.health",
    "replay": "services.replay.service, services.monitor.health",
    "learner": "services.learner.service, services.monitor.health",
}


def interpolated(text: str, variables: dict[str, str]) -> str:
    """What compose makes of `${NAME:-default}`."""
    return re.sub(r"\$\{(\w+):-([^}]*)\}", lambda m: variables.get(m[1]) or m[2], text)


def compose(name: str, variables: dict[str, str] | None = None) -> dict[str, Any]:
    tree: dict[str, Any] = yaml.safe_load(interpolated((ROOT / name).read_text(), variables or {}))
    return tree


def example() -> dict[str, str]:
    """The variables of `.env.example`."""
    lines = (ROOT / ".env.example").read_text().splitlines()
    return dict(line.split("=", 1) for line in lines if line and not line.startswith("#"))


def stages() -> dict[str, tuple[str, str]]:
    """Build stages of the Dockerfile: name to (base, text)."""
    parts = re.split(r"^FROM (\S+) AS (\S+)$", DOCKERFILE, flags=re.MULTILINE)[1:]
    return {name: (base, text) for base, name, text in zip(*[iter(parts)] * 3, strict=True)}


def extras(stage: str) -> set[str]:
    """Extras of our package that a stage and the stages below it install."""
    found: set[str] = set()
    while stage in stages():
        stage, text = stages()[stage]
        for names in re.findall(r"'\.\[([\w,]+)\]'", text):
            found |= set(names.split(","))
    return found


def distributions(names: set[str]) -> set[str]:
    """What the extras bring, extras of extras included."""
    optional = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    found: set[str] = set()
    for name in names:
        for requirement in optional[name]:
            inner = re.match(r"corridor\[([\w,]+)\]", requirement)
            if inner:
                found |= distributions(set(inner[1].split(",")))
            else:
                found.add(re.split(r"[<>=\[]", requirement)[0])
    return found


# ---------------------------------------------------------------- images


def role(name: str) -> str:
    """The service that an image or a service of the compose file runs."""
    return next(process.name for process in PROCESSES if name in process.images)


def test_every_service_has_an_image_of_its_own_run_by_nobody_special() -> None:
    for name in IMAGES:
        text = stages()[name][1]
        assert "COPY --from=code /code /opt/venv" in text
        assert text.index("USER corridor") > text.index("COPY")
        assert 'ENTRYPOINT ["corridor"]' in text
        assert f'CMD ["{role(name)}"' in text
    assert stages()["base"][0] == "${BASE_IMAGE}"


def test_there_is_one_image_for_each_process_with_what_it_needs() -> None:
    ours = {name for name, (_, text) in stages().items() if "HEALTHCHECK" in text}
    assert ours == set(IMAGES)
    for process in PROCESSES:
        for number, image in enumerate(process.images):
            assert set(process.extras[number : number + 1]) <= extras(image)


def test_images_are_small_where_they_can_be() -> None:
    assert distributions(extras("router")) == {"cryptography"}
    for kind in ("robotino", "ros2"):
        held = distributions(extras(DRIVERS[kind]))
        assert held & {"torch", "pybullet", "opencv-python-headless", "openvino"} == set()
    assert "torch" not in distributions(extras("driver-sim"))
    for name in ("actor", "replay", "learner"):
        held = distributions(extras(name))
        assert "pybullet" not in held
        assert ("openvino" in held) == (name != "learner")  # it predicts nothing


@pytest.mark.parametrize("name", IMAGES)
def test_an_image_holds_what_its_service_imports(name: str) -> None:
    present = distributions(extras(name))
    absent = [module for package, module in FOREIGN.items() if package not in present]
    code = f"import sys; sys.modules.update(dict.fromkeys({absent})); import {MODULES[name]}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_a_preset_needs_no_library_of_experiments() -> None:
    foreign = [*FOREIGN.values(), "gymnasium", "matplotlib"]
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({foreign})); "
        "from shared import settings; settings.load('demo'); import services.robot_driver.service"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_every_stage_that_installs_takes_the_index_it_is_told() -> None:
    for name, (_, text) in stages().items():
        if "pip install" in text:
            assert "ARG PIP_INDEX_URL" in text, name


def test_the_image_context_holds_what_is_copied() -> None:
    allowed = {
        line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line[:1] == "!"
    }
    copied: set[str] = set()
    for line in re.findall(r"^COPY (?!--from)(.*)$", DOCKERFILE, flags=re.MULTILINE):
        copied |= set(line.split()[:-1])
    assert copied == allowed
    assert all((ROOT / name).exists() for name in allowed)


# ---------------------------------------------------------------- compose


def test_compose_runs_every_service_with_restart_policy_and_health_check() -> None:
    tree = compose("docker-compose.yml")
    assert set(tree["services"]) == {"router", "credentials", "operator", *ROLES}
    for name in ROLES:
        service = tree["services"][name]
        target = service["build"]["target"]
        assert target == ("driver-demo" if name == "driver" else name)
        assert service["image"] == f"corridor-{target}"
        assert service["command"][0] == name
        assert "profiles" not in service  # `docker compose up` starts it, and so does the machine
        assert service["restart"] == "unless-stopped"
        assert service["depends_on"] == {
            "credentials": {"condition": "service_completed_successfully"},
            "router": {"condition": "service_started"},
        }
        check = json.dumps(service["healthcheck"]["test"][1:])
        assert f"CMD {check}" in stages()[IMAGE_OF.get(name, name)][1]
    assert tree["services"]["router"]["restart"] == "unless-stopped"


def test_containers_may_do_nothing_but_their_work() -> None:
    for name, service in compose("docker-compose.yml")["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true"]
        assert service["tmpfs"] == ["/tmp"]  # noqa: S108
        assert {"cpus", "mem_limit", "pids_limit"} <= set(service)
        assert "ports" not in service  # the router is for the compose network only
        assert "privileged" not in service


def test_state_lies_in_named_volumes() -> None:
    tree = compose("docker-compose.yml")
    for name in ROLES:
        volumes = [f"{name}:/data", f"{name}-credentials:/credentials:ro"]
        assert tree["services"][name]["volumes"] == volumes
        assert name in tree["volumes"]


def test_one_variable_chooses_the_robot_and_its_driver() -> None:
    for preset in settings.preset_names():
        driver = compose("docker-compose.yml", {"PRESET": preset})["services"]["driver"]
        kind = settings.load(preset).robot.kind
        target = driver["build"]["target"]
        base = stages()[target][0] if target not in IMAGES else target
        assert base == DRIVERS[kind]
        assert driver["command"][2] == preset


def test_the_router_is_zenohd_of_the_version_of_its_clients() -> None:
    pins = (ROOT / "constraints.txt").read_text()
    version = re.search(r"^eclipse-zenoh==(\S+)$", pins, flags=re.MULTILINE)
    assert version is not None
    router = compose("docker-compose.yml")["services"]["router"]
    assert router["image"] == f"eclipse/zenoh:{version[1]}"
    assert router["volumes"] == ["router-credentials:/credentials:ro"]
    assert router["command"] == ["--config", "/credentials/router.json5"]


def test_the_first_up_makes_credentials_and_each_container_sees_its_own(tmp_path: Path) -> None:
    tree = compose("docker-compose.yml", {"CORRIDOR_ROBOT__ID": "r7", "ROUTER_HOST": "lab.example"})
    maker, made = tree["services"]["credentials"], tmp_path / "volumes"
    assert maker["image"] == tree["services"]["operator"]["image"] == "corridor-router"
    places = dict(volume.split(":") for volume in maker["volumes"])
    assert {path for path in places.values() if path != "/credentials"} == set(
        re.findall(r"/deliver/\w+", stages()["router"][1])
    )
    for path in places.values():  # as the image has them
        (made / path[1:]).mkdir(parents=True)
    assert main([word.replace("/", f"{made}/", 1) for word in maker["command"]]) == 0
    for name, service in tree["services"].items():
        volumes = [volume.split(":") for volume in service.get("volumes", [])]
        seen = [volume for volume, path, *_ in volumes if path == "/credentials"]
        if name == "credentials":
            continue
        assert [mode for _, path, *mode in volumes if path == "/credentials"] == [["ro"]]
        files = {path.name for path in (made / places[seen[0]][1:]).iterdir()}
        more = {"router.json5"} if name == "router" else set()
        assert files == {"key.pem", "cert.pem", "ca.pem", *more}, name
    zenohd = zenoh.Config.from_file(str(made / "deliver/router/router.json5"))
    assert json.loads(zenohd.get_json("listen/endpoints")) == ["tls/0.0.0.0:7447"]
    assert {"lab.example", "router"} < set(Authority(made / "credentials").hosts)
    assert "driver-r7" in Authority(made / "credentials").credentials


def test_our_own_router_needs_no_other_image() -> None:
    router = compose("docker-compose.own-router.yml")["services"]["router"]
    assert router["image"] == "corridor-router"
    assert router["build"]["target"] == "router"
    assert router["command"][0] == "router"
    assert router["environment"] == {"CORRIDOR_CREDENTIALS": "/credentials"}
    check = json.dumps(router["healthcheck"]["test"][1:])
    assert f"CMD {check}" in stages()["router"][1]


@pytest.mark.parametrize("variables", [{}, example()], ids=["defaults", "example"])
@pytest.mark.parametrize("gpu", [False, True], ids=["cpu", "gpu"])
def test_all_services_get_the_same_valid_configuration(
    variables: dict[str, str], gpu: bool
) -> None:
    found = set()
    for service in ROLES:
        tree = compose("docker-compose.yml", variables)["services"][service]
        environment = dict(tree["environment"])
        if gpu:
            more = compose("docker-compose.gpu.yml")["services"][service]["environment"]
            environment.update(more)
        config = settings.load(preset=tree["command"][2], env=environment)
        assert config.bus.endpoint == "tls/router:7447"
        assert config.bus.credentials == "/credentials"
        assert config.numerics.learner.device == ("cuda" if gpu else "auto")
        found.add(config.fingerprint())
    assert len(found) == 1


def test_the_trial_takes_a_valid_configuration_of_all_services() -> None:
    trial = compose("tests/compose/small.yml")["services"]
    services = compose("docker-compose.yml")["services"]
    assert set(trial) == set(ROLES)
    for name, service in trial.items():
        environment = {**services[name]["environment"], **service["environment"]}
        config = settings.load("demo", env=environment)
        assert (config.network.filters, config.episode.horizon) == (8, 20)


def test_the_gpu_goes_to_those_whose_device_it_is() -> None:
    tree = compose("docker-compose.gpu.yml")
    assert {name for name, s in tree["services"].items() if "deploy" in s} == {"replay", "learner"}


def test_the_example_names_the_variables_of_the_compose_files_and_no_others() -> None:
    names = ("docker-compose.yml", "docker-compose.own-router.yml")
    used = set(re.findall(r"\$\{(\w+)", "".join((ROOT / name).read_text() for name in names)))
    assert used == set(example())


# ---------------------------------------------------------------- health


@pytest.fixture
def config(router: str, run_name: str) -> Config:
    return Config(bus=BusConfig(endpoint=router, heartbeat_s=0.2), run=RunConfig(name=run_name))


def sickness(name: str, config: Config) -> str:
    """Why a service is not healthy."""
    with pytest.raises(health.Sick) as caught:
        health.check(name, config)
    return str(caught.value)


@contextmanager
def beating(config: Config, stream: Stream, beat: Message, ident: str = "main") -> Iterator[None]:
    """Send a heartbeat again and again while the block runs."""
    done = threading.Event()
    with Bus(config.bus, config.run.name) as bus:

        def send() -> None:
            while not done.wait(0.05):
                bus.publish(stream, beat, ident)

        thread = threading.Thread(target=send)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()


def test_a_router_is_healthy_when_it_accepts_sessions(config: Config) -> None:
    assert health.check("router", config) == "accepts sessions"
    nobody = config.model_copy(update={"bus": BusConfig(endpoint="tcp/127.0.0.1:9")})
    assert "no Zenoh router at tcp/127.0.0.1:9" in sickness("router", nobody)


def test_a_missing_service_is_not_healthy(config: Config) -> None:
    for name in ROLES:
        assert "nobody answers" in sickness(name, config)
    assert "expected one of" in sickness("camera", config)


def test_a_service_that_answers_but_does_not_work_is_not_healthy(config: Config) -> None:
    for name in ("replay", "learner"):
        with fake_service(config, name, "main", []):
            assert "no heartbeat" in sickness(name, config)


def test_a_service_with_a_heartbeat_is_healthy_and_tells_what_it_does(config: Config) -> None:
    beat = message(ReplayState, id="main", activity="equalising", progress=0.25, episode=7)
    with fake_service(config, "replay", "main", []), beating(config, REPLAY_STATE, beat):
        assert health.check("replay", config) == "equalising, 25 %, episode 7"
    fit = message(LearnerState, id="main", activity="fitting", fit_batch=1, fit_batches=2)
    with fake_service(config, "learner", "main", []), beating(config, LEARNER_STATE, fit):
        assert health.check("learner", config) == "fitting, epoch 0, 50 %, episode 0"


def test_a_driver_whose_robot_stands_for_a_reason_is_healthy_and_says_so(config: Config) -> None:
    robot = config.robot.id
    beat = message(RobotState, robot=robot, state="blocked", reason="camera 0.8 s old")
    with fake_service(config, "driver", robot, []), beating(config, ROBOT_STATE, beat, robot):
        assert health.check("driver", config) == "blocked, camera 0.8 s old"


def test_an_actor_needs_a_heartbeat_only_for_robots_that_observe(config: Config) -> None:
    robot = config.robot.id
    blocked = message(RobotState, robot=robot, state="blocked")
    driving = message(RobotState, robot=robot, state="waiting")
    acting = message(ActorState, id="main", robot=robot, phase="driving")
    with fake_service(config, "actor", "main", []):
        assert health.check("actor", config) == "waits for a robot"
        with beating(config, ROBOT_STATE, blocked, robot):
            assert health.check("actor", config) == "waits for a robot"
        with beating(config, ROBOT_STATE, driving, robot):
            assert "no heartbeat" in sickness("actor", config)
            with beating(config, ACTOR_STATE, acting, robot):
                assert health.check("actor", config) == f"driving for {robot}"


def test_the_check_says_in_one_line_what_is_or_is_wrong(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, config: Config
) -> None:
    monkeypatch.setenv("CORRIDOR_BUS__ENDPOINT", config.bus.endpoint)
    assert health.main(["router"]) == 0
    assert health.main([]) == 1
    monkeypatch.setenv("CORRIDOR_BUS__ENDPOINT", "tcp")
    assert health.main(["router"]) == 1
    said = capsys.readouterr()
    assert said.out == "accepts sessions\n"
    assert said.err.count("\n") == 2


def test_a_service_that_hangs_is_killed_by_its_tenth_check_in_a_row(tmp_path: Path) -> None:
    answer = tmp_path / "python"

    def check(code: int) -> str:
        answer.write_text(f"#!/bin/sh\nexit {code}\n")
        answer.chmod(0o755)
        environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "KILL": "echo killed"}
        environment["FAILURES"] = str(tmp_path / "failures")
        command = ["/bin/sh", str(ROOT / "deploy" / "healthy"), "actor"]
        done = subprocess.run(command, capture_output=True, text=True, env=environment)
        assert done.returncode == code
        return done.stdout

    assert [check(code) for code in (1, 1, 0)] == ["", "", ""]
    assert [check(1) for _ in range(11)] == [""] * 9 + ["killed\n", ""]


def test_what_the_trial_reads_from_disk_is_what_was_acknowledged(tmp_path: Path) -> None:
    """`tests/compose/stored.py`, which runs in the replay image, and the trial's check of it."""
    config = Config.model_validate({"run": {"name": "trial"}, "memory": {"fill": "none"}})
    settings.claim(tmp_path, config)
    storage = Storage(tmp_path / "replay", config.memory, f"trial/{config.run.seed}")
    for number in (1, 2):
        storage.commit(make_episode(5, seed=number, number=number))
    storage.commit(make_episode(5, seed=2, number=2))  # again: not stored twice
    storage.close()
    done = subprocess.run(
        [sys.executable, "tests/compose/stored.py", str(tmp_path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    stored = json.loads(done.stdout)
    assert [tuple(item) for item in stored["submissions"]] == [
        ("robot1", LIFE, 1),
        ("robot1", LIFE, 2),
    ]
    trial = Trial()
    trial.check_stored(stored, 2)
    assert trial.passed
    for wrong in (
        {"counted": 1},  # fewer than were announced
        {"submissions": stored["submissions"][:1]},
        {"submissions": [stored["submissions"][0]] * 2},
        {"submissions": [["robot1", LIFE, 1], ["robot1", LIFE, 3]]},
        {"episodes": [1, 1]},
    ):
        with pytest.raises(Failed):
            trial.check_stored(stored | wrong, 2)
