"""The paper: one module for each of lessons 02 to 08, its equations beside the code.

``airl`` with its ``rewards`` (02), ``msrd`` (Equation 1; 03), ``divergence`` and ``policy_mixture``
(Equations 2 and 3; 04), ``between_class_discrimination`` (Equation 4; 05), ``dmsrd`` (Algorithm 1; 06) with
``kl_threshold`` (its eps), ``stream`` (Algorithm 1, checkpointed; 08). Imports ``domains``,
``learning`` and ``demonstrations``.
"""
