"""Measures hnswlib on the vectors that benches/search.rs wrote, one thread.

usage: hnswlib_search.py FOLDER DIM K M EF_CONSTRUCTION EF...
needs: pip install hnswlib numpy
"""

import sys
import time
from pathlib import Path

import hnswlib
import numpy as np


def main():
    folder = Path(sys.argv[1])
    dim, k, m, ef_construction = map(int, sys.argv[2:6])
    vectors = np.fromfile(folder / "vectors", np.float32).reshape(-1, dim)
    queries = np.fromfile(folder / "queries", np.float32).reshape(-1, dim)
    truth = np.fromfile(folder / "truth", np.uint32).reshape(-1, k)
    index = hnswlib.Index(space="ip", dim=dim)
    index.init_index(len(vectors), ef_construction=ef_construction, M=m)
    start = time.perf_counter()
    index.add_items(vectors, num_threads=1)
    print(f"built in {time.perf_counter() - start:.1f} s")
    for ef in map(int, sys.argv[6:]):
        index.set_ef(ef)
        start = time.perf_counter()
        found, _ = index.knn_query(queries, k=k, num_threads=1)
        took = time.perf_counter() - start
        hits = sum(len(np.intersect1d(f, t)) for f, t in zip(found, truth))
        print(f"ef {ef}: recall@10 {hits / truth.size:.4f}, speed {len(queries) / took:.0f} queries/s")


main()
