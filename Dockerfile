# Image for CPUs. docs/get-started/demo.md shows how to build and run it.
FROM python:3.12-slim AS build
RUN apt-get update \
 && apt-get install --yes --no-install-recommends g++ make \
 && rm -rf /var/lib/apt/lists/*
RUN pip install --no-cache-dir uv
WORKDIR /source
COPY pyproject.toml CMakeLists.txt README.md LICENSE ./
COPY native native
COPY src src
RUN uv venv /opt/polarguide \
 && uv pip install --no-cache --python /opt/polarguide --torch-backend=cpu .

FROM python:3.12-slim
COPY --from=build /opt/polarguide /opt/polarguide
RUN useradd --create-home polarguide
USER polarguide
WORKDIR /data
ENTRYPOINT ["/opt/polarguide/bin/polarguide"]
CMD ["--help"]
