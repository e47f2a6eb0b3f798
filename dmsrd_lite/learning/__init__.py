"""Acting, and learning to act: small batched networks, rollouts, policy optimisation on given rewards,
cloning.

Imports ``domains`` only. Lessons 01 (rollouts, training) and 02 (cloning) show it.
"""
