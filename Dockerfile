# docker build -t roboarm-nmp .
# docker run --rm roboarm-nmp evaluate --policy go-to-goal --task wall
# docker run --rm -p 8080:8080 roboarm-nmp demo --host 0.0.0.0 --no-open      (the viewer)
# docker run --rm --gpus all -v "$PWD/runs:/home/user/runs" roboarm-nmp train sac --device cuda
# PyTorch comes with CUDA, which takes several GB, also where there is no GPU.
FROM python:3.11-slim

WORKDIR /source
COPY . .
RUN pip install --no-cache-dir -c constraints.txt ".[viewer,trajectories,meshes]" \
    && useradd --create-home --uid 1000 user
USER 1000
WORKDIR /home/user
ENTRYPOINT ["roboarm"]
CMD ["--help"]
