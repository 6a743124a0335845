package dev.wayside.peer;

/** The event of a sample: how fast a client is. Esper wants a public class with getters. */
public final class Speed {
    private final int client;
    private final double speed;

    public Speed(int client, double speed) {
        this.client = client;
        this.speed = speed;
    }

    public int getClient() {
        return client;
    }

    public double getSpeed() {
        return speed;
    }
}
