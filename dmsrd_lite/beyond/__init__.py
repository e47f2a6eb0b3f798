"""What the paper leaves for later: another search for mixture weights (``cma_search``) and another divergence
(``sliced_wasserstein``), both for lesson 04; fewer strategies (``spanning_set``), for lesson 06; and other
people's files (``conversion``).

Imports ``method`` and what that may import.
"""
