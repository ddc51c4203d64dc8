# phasestack in a container: the demo by default, a display with the flags below.
#
#   docker build -t phasestack .
#   docker run --rm phasestack                                      the demo: the built-in recording, no screen
#   docker run --rm -v "$PWD/out:/out" phasestack demo --out /out   its pictures (make out/ writable for uid 990)
#   docker run --rm phasestack doctor
#
# A real display, on a PC with an X server (see docs/operation.md):
#   docker run -d --name display \
#     -e DISPLAY -v /tmp/.X11-unix:/tmp/.X11-unix -v "$XAUTHORITY:/xauthority:ro" -e XAUTHORITY=/xauthority \
#     --device /dev/dri --group-add "$(getent group render | cut -d: -f3)" \
#     -v /dev/bus/usb:/dev/bus/usb --device-cgroup-rule 'c 189:* rmw' \
#     --group-add "$(getent group plugdev | cut -d: -f3)" \
#     -v /etc/phasestack:/etc/phasestack:ro -v phasestack-run:/run/phasestack \
#     phasestack run --config /etc/phasestack/phasestack.toml
# Its page, at http://localhost:8717 (the token: docker exec page cat page-token):
#   docker run -d --name page --network host -v phasestack-run:/run/phasestack phasestack page \
#     --token-file page-token
# NVIDIA: --gpus all -e NVIDIA_DRIVER_CAPABILITIES=all in place of --device /dev/dri.

# Digest of the index of all architectures, as pinned by other projects (not checked against a registry).
# A newer one: docker buildx imagetools inspect python:3.11-slim-bookworm
ARG BASE=python:3.11.14-slim-bookworm@sha256:65a93d69fa75478d554f4ad27c85c1e69fa184956261b4301ebaf6dbb0a3543d

FROM ${BASE} AS build
WORKDIR /src
RUN apt-get update && apt-get install -y --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
# Dependencies first: they change less often than the program.
COPY requirements/runtime.lock requirements/
RUN python -m venv /opt/phasestack \
 && /opt/phasestack/bin/pip install --no-cache-dir -r requirements/runtime.lock
COPY pyproject.toml README.md LICENSE THIRD_PARTY.md ./
COPY phasestack phasestack
COPY runtime runtime
COPY calib calib
COPY model_export model_export
RUN /opt/phasestack/bin/pip install --no-cache-dir --no-deps .

FROM ${BASE} AS runtime
LABEL org.opencontainers.image.title="phasestack" \
      org.opencontainers.image.licenses="Apache-2.0"
# OpenGL without a screen (Mesa), X11 for windows, OpenNI2 and libusb for sensors.
RUN apt-get update \
 && apt-get install -y --no-install-recommends \
      libegl1 libgl1 libgl1-mesa-dri libgles2 \
      libx11-6 libxcursor1 libxi6 libxinerama1 libxrandr2 \
      libopenni2-0 libusb-1.0-0 \
 && rm -rf /var/lib/apt/lists/* \
 && groupadd --system --gid 990 phasestack \
 && useradd --system --uid 990 --gid phasestack --home-dir /var/lib/phasestack --create-home phasestack \
 && install -d -o phasestack -g phasestack -m 0750 /run/phasestack
COPY --from=build /opt/phasestack /opt/phasestack
COPY THIRD_PARTY.md /usr/share/doc/phasestack/THIRD_PARTY.md
ENV PATH=/opt/phasestack/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    ORT_DISABLE_TELEMETRY=1
USER phasestack
WORKDIR /var/lib/phasestack
STOPSIGNAL SIGTERM
# Fails if no daemon answers or its loop hangs; the demo ends before the first check.
HEALTHCHECK --interval=15s --timeout=10s --start-period=60s --retries=3 CMD ["phasestack", "status"]
ENTRYPOINT ["phasestack"]
CMD ["demo"]
