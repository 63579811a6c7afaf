# README's main job in a container:
#   docker build --tag magpend . && docker run --rm --volume "$PWD/results:/work/runs" magpend
# The folder that is mounted must be writable for the user 1000 of the container. Other commands follow the name:
#   docker run --rm --volume "$PWD/results:/work/runs" magpend models
FROM python:3.12-slim AS build
WORKDIR /source
COPY . .
RUN python -m venv /opt/magpend && /opt/magpend/bin/python -m pip install --quiet --no-cache-dir '.[cluster]'

FROM python:3.12-slim
COPY --from=build /opt/magpend /opt/magpend
RUN useradd --create-home --uid 1000 magpend && mkdir --parents /work/runs && chown --recursive magpend /work
USER magpend
WORKDIR /work
ENV PATH=/opt/magpend/bin:$PATH
ENTRYPOINT ["magpend"]
CMD ["run", "quickstart", "--plot"]
