package dev.wayside.peer;

/** The event of a sample: where a client is, in metres. Esper wants a public class with getters. */
public final class Place {
    private final int client;
    private final double x;
    private final double y;

    public Place(int client, double x, double y) {
        this.client = client;
        this.x = x;
        this.y = y;
    }

    public int getClient() {
        return client;
    }

    public double getX() {
        return x;
    }

    public double getY() {
        return y;
    }
}
