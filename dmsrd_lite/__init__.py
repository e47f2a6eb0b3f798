"""dmsrd_lite: the helper package behind the notebooks on learning from heterogeneous demonstrators."""

__version__ = "0.1.0"
