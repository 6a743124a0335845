"""Where a rule's classification contradicts the rule. A contradiction is a warning: the rule runs as it is."""

from wayside.rules.contradictions.case import Case
from wayside.rules.contradictions.table import CONTRADICTIONS, Contradiction, contradictions

__all__ = ["CONTRADICTIONS", "Case", "Contradiction", "contradictions"]
