"""One score for all methods: the metrics of every table (``metrics``), every method through one door
(``comparison``).

Imports ``domains`` to ``method``. Lessons 02 (rewards), 06 and 07 (the comparison) and 08 use it.
"""
