# vslam for the CPU, without root:
#
#   docker build --tag vslam .
#   docker run --rm --volume "$PWD/runs:/work/runs" vslam run --dataset synthetic --seq demo
#
# On Linux, add --user "$(id -u):$(id -g)" if the folder runs/ is not user 1000's.
FROM python:3.11-slim AS wheel
WORKDIR /source
COPY . .
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheel .

FROM python:3.11-slim
COPY --from=wheel /wheel /wheel
COPY constraints.txt /wheel/constraints.txt
RUN pip install --no-cache-dir "$(ls /wheel/vslam-*.whl)[bag]" \
        --constraint /wheel/constraints.txt \
    && useradd --create-home --uid 1000 vslam \
    && install --directory --owner vslam /work /work/runs \
    && install --directory --mode 1777 /cache
ENV NUMBA_CACHE_DIR=/cache/numba VSLAM_CACHE=/cache/vslam MPLCONFIGDIR=/cache/matplotlib
USER vslam
WORKDIR /work
# Kernels are compiled here, once, and not in the first run. Numba refuses a cache that it cannot
# write to: with --user somebody else must.
RUN python -c "from vslam.run.warmup import compile_kernels; compile_kernels(processes=2)" \
    && chmod -R a+rwX /cache/*
ENTRYPOINT ["vslam"]
CMD ["--help"]
