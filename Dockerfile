# One image per service, small because each holds only what its service imports:
#
#   docker build --target actor --tag corridor-actor .
#
# Targets: router, driver (simulation, without torch), actor (without pybullet), replay, learner.
# docker-compose.yml builds all of them.
#
# BASE_IMAGE needs Python 3.11 with venv. TORCH_INDEX_URL: one of PyTorch's own package indexes, to
# choose a CPU-only build (much smaller images) or a CUDA build; empty takes the usual one.
ARG BASE_IMAGE=python:3.11-slim-bookworm

# ------------------------------------------------ virtual environments: dependencies before code

FROM ${BASE_IMAGE} AS base
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1
RUN python3 -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH
WORKDIR /src
# As much as pip needs to resolve dependencies: a change of the code keeps the layers below.
COPY pyproject.toml constraints.txt LICENSE ./
RUN touch README.md && pip install --constraint constraints.txt .

FROM base AS code
COPY README.md ./
COPY shared shared
COPY services services
COPY experiments experiments
RUN pip wheel --no-deps --wheel-dir /wheels .

FROM base AS router-env
COPY --from=code /wheels /wheels
RUN pip install --no-deps --force-reinstall /wheels/*.whl

FROM base AS driver-env
RUN pip install --constraint constraints.txt '.[sim]'
COPY --from=code /wheels /wheels
RUN pip install --no-deps --force-reinstall /wheels/*.whl

FROM base AS torch
ARG TORCH_INDEX_URL=
RUN if [ -n "$TORCH_INDEX_URL" ]; then \
      pip install --constraint constraints.txt --no-deps --index-url "$TORCH_INDEX_URL" torch; \
    fi && \
    pip install --constraint constraints.txt '.[actor]'

FROM torch AS actor-env
RUN pip install --constraint constraints.txt '.[actor,openvino]'
COPY --from=code /wheels /wheels
RUN pip install --no-deps --force-reinstall /wheels/*.whl

FROM torch AS replay-env
RUN pip install --constraint constraints.txt '.[replay,openvino]'
COPY --from=code /wheels /wheels
RUN pip install --no-deps --force-reinstall /wheels/*.whl

FROM torch AS learner-env
RUN pip install --constraint constraints.txt '.[learner]'
COPY --from=code /wheels /wheels
RUN pip install --no-deps --force-reinstall /wheels/*.whl

# ------------------------------------------------ images: an unprivileged user, state below /data

FROM ${BASE_IMAGE} AS runtime
RUN useradd --uid 10001 --create-home corridor && \
    install --directory --owner corridor --group corridor /data
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1
USER corridor
# Run folders are /data/runs/<run name>.
WORKDIR /data
ENTRYPOINT ["corridor"]

FROM runtime AS router
COPY --from=router-env /opt/venv /opt/venv
HEALTHCHECK --interval=15s --timeout=10s --start-period=20s --retries=3 \
    CMD ["python", "-m", "services.monitor.health", "router"]
CMD ["router", "--listen", "tcp/0.0.0.0:7447"]

FROM runtime AS driver
COPY --from=driver-env /opt/venv /opt/venv
HEALTHCHECK --interval=15s --timeout=10s --start-period=20s --retries=3 \
    CMD ["python", "-m", "services.monitor.health", "driver"]
CMD ["driver"]

FROM runtime AS actor
COPY --from=actor-env /opt/venv /opt/venv
HEALTHCHECK --interval=15s --timeout=10s --start-period=20s --retries=3 \
    CMD ["python", "-m", "services.monitor.health", "actor"]
CMD ["actor"]

FROM runtime AS replay
COPY --from=replay-env /opt/venv /opt/venv
HEALTHCHECK --interval=15s --timeout=10s --start-period=20s --retries=3 \
    CMD ["python", "-m", "services.monitor.health", "replay"]
CMD ["replay"]

FROM runtime AS learner
COPY --from=learner-env /opt/venv /opt/venv
HEALTHCHECK --interval=15s --timeout=10s --start-period=20s --retries=3 \
    CMD ["python", "-m", "services.monitor.health", "learner"]
CMD ["learner"]
