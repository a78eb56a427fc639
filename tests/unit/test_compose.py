"""Images and compose files fit the code: roles, settings, health checks."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml
from fakes import fake_service, message

from services.monitor import health
from shared import settings
from shared.bus import Bus
from shared.config import BusConfig, Config, RunConfig
from shared.keys import REPLAY_STATE
from shared.messages import ReplayState

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text()
SERVICES = ("router", "driver", "actor", "replay", "learner")
FOREIGN = {
    "pybullet": "pybullet",
    "opencv-python-headless": "cv2",
    "openvino": "openvino",
    "torch": "torch",
    "safetensors": "safetensors",
    "lmdb": "lmdb",
    "tensorboard": "tensorboard",
}
"""Distributions that not every image holds, and what they are imported as."""
MODULES = {
    "router": "services.router.service, services.monitor.health, services.monitor.status",
    "driver": "services.robot_driver.service, services.robot_driver.sim, services.monitor.health",
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


def test_every_service_has_an_image_with_its_own_environment() -> None:
    for name in SERVICES:
        base, text = stages()[name]
        assert base == "runtime"
        assert f"COPY --from={name}-env /opt/venv" in text
        assert f'CMD ["{name}"' in text
    assert stages()["runtime"][0] == "${BASE_IMAGE}"
    assert "USER corridor" in stages()["runtime"][1]


def test_images_are_small_where_they_can_be() -> None:
    assert distributions(extras("router-env")) == set()
    assert "torch" not in distributions(extras("driver-env"))
    for name in ("actor", "replay", "learner"):
        held = distributions(extras(f"{name}-env"))
        assert "pybullet" not in held
        assert ("openvino" in held) == (name != "learner")  # it predicts nothing


@pytest.mark.parametrize("name", SERVICES)
def test_an_image_holds_what_its_service_imports(name: str) -> None:
    present = distributions(extras(f"{name}-env"))
    absent = [module for package, module in FOREIGN.items() if package not in present]
    code = f"import sys; sys.modules.update(dict.fromkeys({absent})); import {MODULES[name]}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr


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
    assert set(tree["services"]) == set(SERVICES)
    for name, service in tree["services"].items():
        assert service["build"]["target"] == name
        assert service["command"][0] == name
        assert service["restart"] == ("unless-stopped" if name == "router" else "on-failure")
        check = json.dumps(service["healthcheck"]["test"][1:])
        assert f"CMD {check}" in stages()[name][1]
        assert "ports" not in service  # the router is for the compose network only


def test_the_router_comes_first_and_state_lies_in_named_volumes() -> None:
    tree = compose("docker-compose.yml")
    for name in SERVICES[1:]:
        service = tree["services"][name]
        assert service["depends_on"] == {"router": {"condition": "service_healthy"}}
        assert service["volumes"] == [f"{name}:/data"]
        assert name in tree["volumes"]


def test_only_the_simulated_robot_needs_a_profile() -> None:
    services = compose("docker-compose.yml")["services"]
    assert {n: s["profiles"] for n, s in services.items() if "profiles" in s} == {"driver": ["sim"]}
    assert example()["COMPOSE_PROFILES"] == "sim"


@pytest.mark.parametrize("variables", [{}, example()], ids=["defaults", "example"])
@pytest.mark.parametrize("gpu", [False, True], ids=["cpu", "gpu"])
def test_all_services_get_the_same_valid_configuration(
    variables: dict[str, str], gpu: bool
) -> None:
    found = set()
    for service in SERVICES[1:]:
        tree = compose("docker-compose.yml", variables)["services"][service]
        environment = dict(tree["environment"])
        if gpu:
            more = compose("docker-compose.gpu.yml")["services"][service]["environment"]
            environment.update(more)
        config = settings.load(preset=tree["command"][2], env=environment)
        assert config.bus.endpoint == "tcp/router:7447"
        assert config.numerics.learner.device == ("cuda" if gpu else "auto")
        found.add(config.fingerprint())
    assert len(found) == 1


def test_the_gpu_goes_to_those_whose_device_it_is() -> None:
    tree = compose("docker-compose.gpu.yml")
    assert {name for name, s in tree["services"].items() if "deploy" in s} == {"replay", "learner"}


def test_the_example_names_the_variables_of_the_compose_file_and_no_others() -> None:
    text = (ROOT / "docker-compose.yml").read_text()
    used = set(re.findall(r"\$\{(\w+)", text))
    assert used | {"COMPOSE_PROFILES"} == set(example())


# ---------------------------------------------------------------- health


@pytest.fixture
def config(router: str, run_name: str) -> Config:
    return Config(bus=BusConfig(endpoint=router, heartbeat_s=0.2), run=RunConfig(name=run_name))


def test_a_router_is_healthy_when_it_accepts_sessions(config: Config) -> None:
    assert health.problem("router", config) == ""
    nobody = config.model_copy(update={"bus": BusConfig(endpoint="tcp/127.0.0.1:9")})
    assert "no Zenoh router at tcp/127.0.0.1:9" in health.problem("router", nobody)


def test_a_missing_service_is_not_healthy(config: Config) -> None:
    for name in SERVICES[1:]:
        assert "nobody answers" in health.problem(name, config)
    assert "expected one of" in health.problem("camera", config)


def test_an_answer_is_enough_for_an_actor_only(config: Config) -> None:
    with fake_service(config, "actor", "main", []):
        assert health.problem("actor", config) == ""
    with fake_service(config, "replay", "main", []):
        assert "no heartbeat" in health.problem("replay", config)


def test_a_service_with_a_heartbeat_is_healthy(config: Config) -> None:
    done = threading.Event()
    with fake_service(config, "replay", "main", []), Bus(config.bus, config.run.name) as bus:

        def beat() -> None:
            while not done.wait(0.05):
                bus.publish(REPLAY_STATE, message(ReplayState))

        thread = threading.Thread(target=beat)
        thread.start()
        try:
            assert health.problem("replay", config) == ""
        finally:
            done.set()
            thread.join()


def test_the_check_says_what_is_wrong_in_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, config: Config
) -> None:
    monkeypatch.setenv("CORRIDOR_BUS__ENDPOINT", config.bus.endpoint)
    assert health.main(["router"]) == 0
    assert health.main([]) == 1
    monkeypatch.setenv("CORRIDOR_BUS__ENDPOINT", "tcp")
    assert health.main(["router"]) == 1
    assert capsys.readouterr().err.count("\n") == 2
