"""The application manager: runs the applications that live ApplicationTasks demand."""
