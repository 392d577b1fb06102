# syntax=docker/dockerfile:1
# The server in one image: binary, ONNX Runtime, the built-in model. Data lives in /data.

FROM rust:1.95-bookworm AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends nasm python3 python3-pip \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY deploy deploy
COPY Makefile ./
RUN make assets
COPY . .
RUN make build

FROM debian:bookworm-slim
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 --home-dir /data whereabouts \
    && install -d -o whereabouts /data
COPY --from=build /src/assets /usr/lib/whereabouts
COPY --from=build /src/target/release/whereabouts /usr/bin/whereabouts
COPY LICENSE /usr/share/doc/whereabouts/LICENSE
USER whereabouts
VOLUME /data
EXPOSE 8080
ENV WHEREABOUTS_DATA__DIR=/data \
    WHEREABOUTS_SERVER__LISTEN=0.0.0.0:8080 \
    WHEREABOUTS_LOG__FORMAT=json
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s CMD ["whereabouts", "healthcheck"]
STOPSIGNAL SIGTERM
ENTRYPOINT ["whereabouts"]
CMD ["serve"]
