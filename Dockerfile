# The demo: trains on the built-in scene on the CPU and leaves the run in /data/runs.
#
#   docker build -t warpgs . && docker run --rm -v "$PWD:/data" warpgs
#
# Any other command: docker run --rm -v "$PWD:/data" warpgs export runs/builtin-quick
FROM python:3.12-slim
COPY constraints.txt /tmp/
RUN pip install --no-cache-dir -c /tmp/constraints.txt torch --index-url https://download.pytorch.org/whl/cpu
COPY . /src
RUN pip install --no-cache-dir -c /tmp/constraints.txt '/src[viewer]' && rm -rf /src
WORKDIR /data
ENTRYPOINT ["warpgs"]
CMD ["train"]
