"""Episodes: from a rule's condition for a subject to events and the demands of actions."""
