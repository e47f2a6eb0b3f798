"""What the notebooks need: every number (``presets``), a lesson's frame, figures, videos, records, plans, the
benchmark.

Imports everything to its left: ``domains`` to ``demonstrators``. Every lesson starts with ``lessons.start``.
"""
