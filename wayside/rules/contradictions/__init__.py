"""Contradictions between a rule and its classification. A contradiction is only a warning: the rule runs."""

from wayside.rules.contradictions.case import Case
from wayside.rules.contradictions.table import CONTRADICTIONS, Contradiction, contradictions

__all__ = ["CONTRADICTIONS", "Case", "Contradiction", "contradictions"]
