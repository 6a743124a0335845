"""What every process of ours needs: its start, command line, certificate, traces and retries."""
