"""The actions of a rule, one module per kind: their models. They run in detector/actions."""
