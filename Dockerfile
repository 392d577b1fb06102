# syntax=docker/dockerfile:1
# The server as an image: binary, ONNX Runtime, the built-in model. It writes only to /data.
# Requires BuildKit, the default of `docker build` since version 23.

FROM rust:1.95-bookworm AS build
# Unpinned, so that a new build gets Debian's security updates.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends nasm python3 python3-pip \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
# Only the files that determine the assets, so that other changes do not download them again.
COPY deploy/setup deploy/setup
COPY deploy/models deploy/models
RUN deploy/setup/assets.sh --reader assets
COPY . .
# Caches keep crates and compiled dependencies across source changes. The sources are touched because cargo compares
# modification times, and those of another checkout may be older than the cached build.
RUN --mount=type=cache,id=whereabouts-crates,target=/usr/local/cargo/registry,sharing=locked \
    --mount=type=cache,id=whereabouts-target,target=/src/target,sharing=locked \
    find . -path ./assets -prune -o -path ./target -prune -o -type f -exec touch {} + \
    && make build \
    && strip -o /whereabouts target/release/whereabouts

FROM debian:bookworm-slim
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates \
    && rm -rf /var/lib/apt/lists/* \
    && groupadd --gid 10001 whereabouts \
    && useradd --uid 10001 --gid whereabouts --home-dir /data --no-create-home \
        --shell /usr/sbin/nologin whereabouts \
    && install -d -o whereabouts -g whereabouts -m 0750 /data
COPY --from=build /src/assets/onnxruntime /usr/lib/whereabouts/onnxruntime
COPY --from=build /src/assets/models /usr/lib/whereabouts/models
COPY LICENSE /usr/share/doc/whereabouts/LICENSE
COPY --from=build /whereabouts /usr/bin/whereabouts
# Numeric, so that Kubernetes can verify runAsNonRoot.
USER 10001:10001
VOLUME /data
EXPOSE 8080
# Models installed later go to the volume; the built-in model and ONNX Runtime are still found.
ENV WHEREABOUTS_DATA__DIR=/data \
    WHEREABOUTS_MODEL__ASSETS=/data/assets \
    WHEREABOUTS_SERVER__LISTEN=0.0.0.0:8080 \
    WHEREABOUTS_LOG__FORMAT=json
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s CMD ["whereabouts", "healthcheck"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["whereabouts"]
CMD ["serve"]
