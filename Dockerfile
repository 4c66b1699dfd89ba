# For the CPU:   docker build -t roboarm-nmp .
# With CUDA:     docker build -t roboarm-nmp --build-arg TORCH_INDEX=https://pypi.org/simple .
# Then:          docker run --rm roboarm-nmp evaluate --policy go-to-goal --task wall
# The viewer:    docker run --rm -p 8080:8080 roboarm-nmp demo --host 0.0.0.0 --no-open
# On a GPU:      docker run --rm --gpus all -v "$PWD/runs:/work/runs" roboarm-nmp train sac --device cuda
FROM python:3.11-slim

ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
SHELL ["/bin/bash", "-o", "pipefail", "-c"]

WORKDIR /source
COPY constraints.txt ./
RUN grep '^torch==' constraints.txt > torch.txt \
    && pip install --no-cache-dir --index-url "$TORCH_INDEX" -r torch.txt
COPY . .
RUN pip install --no-cache-dir -c constraints.txt ".[viewer,trajectories,meshes]"

RUN useradd --create-home --uid 1000 user && mkdir /work && chown 1000 /work
USER 1000
WORKDIR /work
ENTRYPOINT ["roboarm"]
CMD ["--help"]
