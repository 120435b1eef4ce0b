# An image that trains: docker build -t ksim_rl . && docker run --rm --gpus all -v "$PWD/runs:/train/runs" ksim_rl train task=cartpole_swingup
# The file is linted by the tests; nobody has built it where they run, since they have no Docker engine.
FROM python:3.12-slim

# What MuJoCo draws with, and the compiler that Triton's and torch's kernels need at run time.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends gcc libc6-dev libegl1 libgles2 \
    && rm -rf /var/lib/apt/lists/*

COPY pyproject.toml constraints.txt README.md LICENSE /src/
COPY ksim_rl /src/ksim_rl
RUN pip install --no-cache-dir -c /src/constraints.txt "/src[menagerie]"

# Graphics for the NVIDIA runtime, and a cache of kernels that a volume can keep: -v ksim_rl_cache:/cache
ENV MUJOCO_GL=egl NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics WARP_CACHE_PATH=/cache/warp \
    TRITON_CACHE_DIR=/cache/triton TORCHINDUCTOR_CACHE_DIR=/cache/inductor
WORKDIR /train
ENTRYPOINT ["ksim-rl"]
CMD ["--help"]
