"""The real system in real processes, for tests: see `benchmarks/cluster.py`."""

from benchmarks.cluster import ALL, SERVICES, Cluster, free_port, make_config

__all__ = ["ALL", "SERVICES", "Cluster", "free_port", "make_config"]
