# The demo: trains on the built-in scene on the CPU and leaves the run in /data/runs.
#
#   docker build -t warpgs . && docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" warpgs
#
# Any other command: docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" warpgs export runs/builtin-quick
# On a GPU: docker build --build-arg TORCH=https://download.pytorch.org/whl/cu130 …, and docker run --gpus all …
FROM python:3.12-slim AS build
ARG TORCH=https://download.pytorch.org/whl/cpu
RUN python -m venv /opt/warpgs
ENV PATH=/opt/warpgs/bin:$PATH
COPY constraints.txt /tmp/
RUN pip install --no-cache-dir -c /tmp/constraints.txt torch --index-url "$TORCH"
COPY . /src
RUN pip install --no-cache-dir -c /tmp/constraints.txt '/src[viewer]'

FROM python:3.12-slim
COPY --from=build /opt/warpgs /opt/warpgs
RUN useradd --create-home warpgs && install -d -o warpgs /data
# Compiled kernels and the built-in scene stay in the mounted folder, which any user of the container can write.
ENV PATH=/opt/warpgs/bin:$PATH WARP_CACHE_PATH=/data/.cache/warp XDG_CACHE_HOME=/data/.cache \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility
USER warpgs
WORKDIR /data
VOLUME /data
ENTRYPOINT ["warpgs"]
CMD ["train"]
