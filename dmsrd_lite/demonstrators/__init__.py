"""Who shows: demonstrators trained (``diayn``), chosen (``choice``) and mixed (``streams``), and test sets
for rewards.

Imports ``domains`` to ``evaluation``. Lesson 01 shows it; ``python -m dmsrd_lite generate`` runs it.
"""
