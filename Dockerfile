# The command tint-sumo with SUMO and PyTorch's CPU build:
#
#     docker build --tag tint-sumo .
#     docker run --rm --volume "$PWD/results:/results" tint-sumo study run --budget quick --out quick
FROM python:3.12-slim AS build
WORKDIR /source
COPY pyproject.toml ./
RUN python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['dependencies'], sep='\n')" \
    > requirements.txt
COPY README.md LICENSE ./
COPY tint_sumo tint_sumo
COPY sumo_net sumo_net
COPY data/models data/models
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /dist .

FROM python:3.12-slim

# what SUMO's programs need from the system
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libatomic1 libgl1 libxext6 libxrender1 \
    && rm -rf /var/lib/apt/lists/*

# The libraries are a layer of their own, which stays the same until pyproject.toml changes.
RUN pip install --no-cache-dir torch==2.13.0 --index-url https://download.pytorch.org/whl/cpu
RUN --mount=type=bind,from=build,source=/source/requirements.txt,target=/requirements.txt \
    pip install --no-cache-dir --requirement /requirements.txt
RUN --mount=type=bind,from=build,source=/dist,target=/dist \
    pip install --no-cache-dir --no-deps /dist/*.whl

RUN useradd --uid 1000 --create-home driver && install --directory --owner driver /results
USER 1000
WORKDIR /results
VOLUME /results
ENTRYPOINT ["tint-sumo"]
CMD ["--help"]
