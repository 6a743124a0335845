# Both programs in one image: `detector` and `application-manager`. It has no entrypoint: a pod selects the program.
#
#   docker build -t wayside --build-arg VERSION=$(git describe --always) .
#
# With --build-arg REQUIREMENTS=requirements-full.txt it also has the packages for ONNX models, Protobuf recordings and
# results of replays; docs/images.md explains how both are built for two architectures, published and signed.
#
# The base is pinned by its digest (Python 3.13 on Debian 13), the packages by docker/requirements.txt, with hashes.
# Files contain no times of the build, so the same source gives the same layers (BuildKit: also give
# --build-arg SOURCE_DATE_EPOCH=0 and --output type=image,rewrite-timestamp=true; buildah: --timestamp 0). If the base
# comes from a registry of your own: --build-arg BASE=<a Debian with Python 3.11 to 3.13, venv and pip>.
ARG BASE=docker.io/library/python:3.13-slim-trixie@sha256:9d2e5553305c7c7b0097999bb17187c69b921ccd6bc9d40e4bb5ebe652c00285

FROM ${BASE} AS build
ENV PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_CACHE_DIR=1 PYTHONDONTWRITEBYTECODE=1
RUN python3 -m venv /opt/wayside
COPY docker/requirements.txt docker/requirements-full.txt /source/docker/
ARG REQUIREMENTS=requirements.txt
# An index of packages of your own: --secret id=pip.conf,src=pip.conf. Without it pip finds no such file, and uses PyPI.
RUN --mount=type=secret,id=pip.conf PIP_CONFIG_FILE=/run/secrets/pip.conf \
    /opt/wayside/bin/pip install --no-compile --only-binary=:all: --require-hashes -r "/source/docker/${REQUIREMENTS}"
COPY pyproject.toml README.md LICENSE /source/
COPY wayside /source/wayside
COPY detector /source/detector
COPY application_manager /source/application_manager
# The builder of the wheel (setuptools) is in the requirements, so nothing is fetched here.
RUN /opt/wayside/bin/pip install --no-compile --no-deps --no-build-isolation /source \
 && /opt/wayside/bin/pip uninstall --yes --quiet setuptools pip
# Of pycrate's ASN.1 modules only those of ITS messages; all others, of mobile networks mostly, are 140 MB. The wheel of
# cel-expr-python contains its build tree, 16 MB that nothing imports. The root of a
# container is read-only, so everything is compiled here, otherwise each start would do so: bytecode that is not compared
# with its source contains no times.
RUN find /opt/wayside/lib -path '*/pycrate_asn1dir/*.py' ! -name '__init__.py' ! -name 'ITS*.py' -delete \
 && rm -rf /opt/wayside/lib/python3*/site-packages/bazel-project \
 && python3 -m compileall -q --invalidation-mode=unchecked-hash /opt/wayside/lib

FROM ${BASE}
ARG VERSION=unknown
LABEL org.opencontainers.image.title="wayside" \
      org.opencontainers.image.description="Event detector and application manager for connected vehicles and roadside stations" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}"
COPY --from=build /opt/wayside /opt/wayside
RUN python3 -m compileall -q -x site-packages --invalidation-mode=unchecked-hash "$(python3 -c 'import os; print(os.path.dirname(os.__file__))')"
# HOME can be written to where the root of a container cannot: mount a volume at /tmp.
ENV PATH=/opt/wayside/bin:/usr/local/bin:/usr/bin:/bin HOME=/tmp PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
USER 65532:65532
WORKDIR /
CMD ["detector", "--help"]
