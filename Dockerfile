# One image per service, small because each holds only what its service imports:
#
#   docker build --target actor --tag corridor-actor .
#
# Targets: router; driver-sim (simulated robot), driver-robotino and driver-ros2 (real robots, without
# simulator), also under the names of presets; actor, replay, learner. Drivers have no torch. docker-compose.yml builds all of them.
#
# BASE_IMAGE needs Python 3.11 with venv (deploy/make-base-image.sh makes one from Debian packages).
# TORCH_INDEX_URL: one of PyTorch's own package indexes, to choose a CPU-only build (much smaller
# images) or a CUDA build; empty takes the usual one. PIP_INDEX_URL: another package index.
ARG BASE_IMAGE=python:3.11-slim-bookworm

# ------------------------------------------------ libraries; images share the layers they can

FROM ${BASE_IMAGE} AS base
RUN useradd --uid 10001 --create-home corridor && \
    install --directory --owner corridor --group corridor /data
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python3 -m venv /opt/venv
WORKDIR /src
# As much as pip needs to resolve dependencies: a change of the code keeps the layers below.
COPY pyproject.toml constraints.txt LICENSE ./
ARG PIP_INDEX_URL=
RUN touch README.md && pip install --constraint constraints.txt .

# ------------------------------------------------ our code, as pip lays it out

FROM base AS code
ARG PIP_INDEX_URL=
COPY README.md ./
COPY shared shared
COPY services services
COPY experiments experiments
RUN pip install --no-deps --ignore-installed --prefix /code .
COPY deploy/healthy /code/bin/healthy

# ------------------------------------------------ images: an unprivileged user, state below /data

FROM base AS router
ARG PIP_INDEX_URL=
# It also makes credentials: docker-compose.yml mounts a volume on each of these folders.
RUN pip install --constraint constraints.txt '.[secure]' && \
    install --directory --mode 700 --owner corridor --group corridor /credentials \
      /deliver/router /deliver/driver /deliver/actor /deliver/replay /deliver/learner \
      /deliver/operator
COPY --from=code /code /opt/venv
USER corridor
# Run folders are /data/runs/<run name>.
WORKDIR /data
ENTRYPOINT ["corridor"]
HEALTHCHECK --interval=30s --timeout=15s --start-period=30s --retries=3 \
    CMD ["healthy", "router"]
CMD ["router", "--listen", "tcp/0.0.0.0:7447"]

FROM base AS driver-sim
ARG PIP_INDEX_URL=
RUN pip install --constraint constraints.txt '.[sim]'
COPY --from=code /code /opt/venv
USER corridor
WORKDIR /data
ENTRYPOINT ["corridor"]
HEALTHCHECK --interval=30s --timeout=15s --start-period=30s --retries=3 \
    CMD ["healthy", "driver"]
CMD ["driver"]

FROM base AS driver-robotino
ARG PIP_INDEX_URL=
RUN pip install --constraint constraints.txt '.[robotino]'
COPY --from=code /code /opt/venv
USER corridor
WORKDIR /data
ENTRYPOINT ["corridor"]
HEALTHCHECK --interval=30s --timeout=15s --start-period=30s --retries=3 \
    CMD ["healthy", "driver"]
CMD ["driver"]

FROM base AS driver-ros2
ARG PIP_INDEX_URL=
RUN pip install --constraint constraints.txt '.[ros2]'
COPY --from=code /code /opt/venv
USER corridor
WORKDIR /data
ENTRYPOINT ["corridor"]
HEALTHCHECK --interval=30s --timeout=15s --start-period=30s --retries=3 \
    CMD ["healthy", "driver"]
CMD ["driver"]

FROM base AS torch
ARG PIP_INDEX_URL=
ARG TORCH_INDEX_URL=
RUN if [ -n "$TORCH_INDEX_URL" ]; then \
      pip install --constraint constraints.txt --no-deps --index-url "$TORCH_INDEX_URL" torch; \
    fi && \
    pip install --constraint constraints.txt '.[actor]'

FROM torch AS actor
ARG PIP_INDEX_URL=
RUN pip install --constraint constraints.txt '.[actor,openvino]'
COPY --from=code /code /opt/venv
USER corridor
WORKDIR /data
ENTRYPOINT ["corridor"]
HEALTHCHECK --interval=30s --timeout=15s --start-period=30s --retries=3 \
    CMD ["healthy", "actor"]
CMD ["actor"]

FROM torch AS replay
ARG PIP_INDEX_URL=
RUN pip install --constraint constraints.txt '.[replay,openvino]'
COPY --from=code /code /opt/venv
USER corridor
WORKDIR /data
ENTRYPOINT ["corridor"]
HEALTHCHECK --interval=30s --timeout=15s --start-period=30s --retries=3 \
    CMD ["healthy", "replay"]
CMD ["replay"]

FROM torch AS learner
ARG PIP_INDEX_URL=
RUN pip install --constraint constraints.txt '.[learner]'
COPY --from=code /code /opt/venv
USER corridor
WORKDIR /data
ENTRYPOINT ["corridor"]
HEALTHCHECK --interval=30s --timeout=15s --start-period=30s --retries=3 \
    CMD ["healthy", "learner"]
CMD ["learner"]

# ------------------------------------------------ the driver for each preset: one name chooses both

FROM driver-sim AS driver-demo
FROM driver-sim AS driver-real-corridor
FROM driver-ros2 AS driver-robotino-ros2
FROM driver-ros2 AS driver-turtlebot4
