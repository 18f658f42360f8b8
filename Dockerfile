# The demo: trains on the built-in scene on the CPU and leaves the run in /data/runs.
#
#   docker build -t warpgs . && docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" warpgs
#
# Any other command: docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/data" warpgs export runs/builtin-quick
FROM python:3.12-slim
COPY constraints.txt /tmp/
RUN pip install --no-cache-dir -c /tmp/constraints.txt torch --index-url https://download.pytorch.org/whl/cpu
COPY . /src
RUN pip install --no-cache-dir -c /tmp/constraints.txt '/src[viewer]' && rm -rf /src
# Compiled kernels and the built-in scene stay in the mounted folder, which any user of the container can write.
ENV WARP_CACHE_PATH=/data/.cache/warp XDG_CACHE_HOME=/data/.cache
WORKDIR /data
ENTRYPOINT ["warpgs"]
CMD ["train"]
