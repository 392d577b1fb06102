"""Benchmarks the inference of a model with one peer, on two or more threads.

usage: inference.py PEER FILE SIZE BATCH THREADS SECONDS
       PEER is onnxruntime, openvino-latency or openvino-throughput (both at bf16)
prints: `MILLISECONDS PICTURES_PER_SECOND`: the median latency of a single run, and the throughput with
        the peer's own number of concurrent runs
"""

import sys
import time

import numpy as np


def by_onnxruntime(file, threads):
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    session = onnxruntime.InferenceSession(file, options, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name

    def run(pictures):
        return session.run(None, {name: pictures})

    return run, None


def by_openvino(file, threads, hint, shape):
    import openvino

    core = openvino.Core()
    model = core.read_model(file)
    # A fixed shape: OpenVINO optimises such a graph better than one with dynamic shapes.
    model.reshape(shape)
    compiled = core.compile_model(
        model,
        "CPU",
        {
            "PERFORMANCE_HINT": hint,
            "INFERENCE_PRECISION_HINT": "bf16",
            "INFERENCE_NUM_THREADS": threads,
        },
    )
    request = compiled.create_infer_request()
    side_by_side = compiled.get_property("OPTIMAL_NUMBER_OF_INFER_REQUESTS")
    return (lambda pictures: request.infer({0: pictures})), openvino.AsyncInferQueue(
        compiled, side_by_side
    )


def main():
    peer, file = sys.argv[1:3]
    size, batch, threads = map(int, sys.argv[3:6])
    seconds = float(sys.argv[6])
    shape = (batch, 3, size, size)
    pictures = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    if peer == "onnxruntime":
        run, queue = by_onnxruntime(file, threads)
    else:
        run, queue = by_openvino(file, threads, peer.split("-")[1].upper(), shape)
    for _ in range(3):
        run(pictures)
    times = []
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        begin = time.perf_counter()
        run(pictures)
        times.append(time.perf_counter() - begin)
    rate = batch * len(times) / sum(times)
    if queue:
        done, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            queue.start_async({0: pictures})
            done += 1
        queue.wait_all()
        rate = batch * done / (time.perf_counter() - start)
    print(f"{np.median(times) * 1e3:.3f} {rate:.3f}")


main()
