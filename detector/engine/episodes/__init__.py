"""What a rule's condition makes of a subject: episodes, their events and the demands of their actions."""
