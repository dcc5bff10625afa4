# nerfro in a container. Data and outputs are in /data:
#
#     docker build --target cpu --tag nerfro . && docker run --rm --volume "$PWD":/data nerfro train
#
# The argument VERSION is the version that the package reports, because the build context has no history.

FROM python:3.12-slim-bookworm AS base
ARG VERSION=0.1.0
ENV SETUPTOOLS_SCM_PRETEND_VERSION_FOR_NERFRO=$VERSION PIP_NO_CACHE_DIR=1
RUN useradd --create-home --uid 1000 user
WORKDIR /nerfro
COPY . .
WORKDIR /data

# This stage has never been run. PyPI's torch for Linux is the CUDA build; start the container with `--gpus all`.
FROM base AS cuda
RUN pip install --constraint /nerfro/constraints-cpu.txt "/nerfro[video]"
USER 1000
ENTRYPOINT ["nerfro"]

FROM base AS cpu
RUN pip install --extra-index-url https://download.pytorch.org/whl/cpu --constraint /nerfro/constraints-cpu.txt "/nerfro[video]"
USER 1000
ENTRYPOINT ["nerfro"]
