"""What episodes lead to. Actions run beside the engine, never on its thread, and keep what they count."""
