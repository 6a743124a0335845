"""The application manager: makes a cluster run what the live ApplicationTasks demand."""
