"""One score for all methods: the metrics of every table (``metrics``), every method through one door
(``comparison``), searches for weights side by side (``searches``), and what differences mean
(``statistics``).

Imports ``domains`` to ``beyond``. Lessons 02 (rewards), 04, 06 and 07 (the comparison) and 08 use it.
"""
