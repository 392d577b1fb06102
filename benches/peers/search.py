"""Benchmarks one peer on the vectors written by benches/search.rs, on one thread.

usage: search.py PEER FOLDER DIM K M EF_CONSTRUCTION
       PEER is hnswlib, faiss or usearch (with 16-bit floats; its default is 32-bit)
prints: the build time in seconds; then for each EF that is read from the standard input, one a line,
        `RECALL QUERIES_PER_SECOND`
"""

import sys
import time
from pathlib import Path

import numpy as np


def by_hnswlib(vectors, m, ef_construction):
    import hnswlib

    index = hnswlib.Index(space="ip", dim=vectors.shape[1])
    index.init_index(len(vectors), ef_construction=ef_construction, M=m)
    index.add_items(vectors, num_threads=1)

    def search(queries, k, ef):
        index.set_ef(ef)
        return index.knn_query(queries, k=k, num_threads=1)[0]

    return search


def by_faiss(vectors, m, ef_construction):
    import faiss

    faiss.omp_set_num_threads(1)
    index = faiss.IndexHNSWFlat(vectors.shape[1], m, faiss.METRIC_INNER_PRODUCT)
    index.hnsw.efConstruction = ef_construction
    index.add(vectors)

    def search(queries, k, ef):
        index.hnsw.efSearch = ef
        return index.search(queries, k)[1]

    return search


def by_usearch(vectors, m, ef_construction):
    from usearch.index import Index

    index = Index(
        ndim=vectors.shape[1],
        metric="ip",
        dtype="f16",
        connectivity=m,
        expansion_add=ef_construction,
    )
    index.add(np.arange(len(vectors)), vectors, threads=1)

    def search(queries, k, ef):
        index.expansion_search = ef
        return index.search(queries, k, threads=1).keys

    return search


def main():
    peer, folder = sys.argv[1], Path(sys.argv[2])
    dim, k, m, ef_construction = map(int, sys.argv[3:7])
    vectors = np.fromfile(folder / "vectors", np.float32).reshape(-1, dim)
    queries = np.fromfile(folder / "queries", np.float32).reshape(-1, dim)
    truth = np.fromfile(folder / "truth", np.uint32).reshape(-1, k)
    build = {"hnswlib": by_hnswlib, "faiss": by_faiss, "usearch": by_usearch}[peer]
    start = time.perf_counter()
    search = build(vectors, m, ef_construction)
    print(f"{time.perf_counter() - start:.3f}", flush=True)
    for ef in map(int, sys.stdin):
        start = time.perf_counter()
        found = search(queries, k, ef)
        took = time.perf_counter() - start
        hits = sum(len(np.intersect1d(f, t)) for f, t in zip(found, truth))
        print(f"{hits / truth.size:.6f} {len(queries) / took:.3f}", flush=True)


main()
