"""The deploy action: the demands of open episodes, kept equal to the ApplicationTasks of a holder."""
