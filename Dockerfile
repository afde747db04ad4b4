# mappo-unity with Unity's example scenes; no Unity in it: mount a Linux build.
#   docker build -t mappo-unity .
#   docker run --rm -v "$PWD/outputs:/work/outputs" mappo-unity mappo-train env=3DBall
# With CUDA: --build-arg TORCH_INDEX=https://pypi.org/simple, and docker run --gpus all ... device=cuda
ARG PYTHON=3.12
FROM python:${PYTHON}-slim-bookworm

# EGL, with which MuJoCo draws videos without a display or a graphics card
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libegl1 libgl1-mesa-dri \
    && rm -rf /var/lib/apt/lists/*

# torch first, in a layer of its own: it is large, and changes less often than the project
ARG TORCH_INDEX=https://download.pytorch.org/whl/cpu
RUN pip install --no-cache-dir "torch>=2.11,<2.14" --index-url "${TORCH_INDEX}"

ARG EXTRAS=video
COPY pyproject.toml README.md LICENSE /src/
COPY mappo_unity /src/mappo_unity
COPY conf /src/conf
RUN pip install --no-cache-dir "/src[${EXTRAS}]"

# the runs of a user who mounts a folder belong to that user with --user "$(id -u):$(id -g)"
ENV HOME=/tmp PYTHONUNBUFFERED=1
WORKDIR /work
RUN mkdir outputs && chmod 777 outputs

CMD ["mappo-train", "--help"]
