package dev.wayside.peer;

/** Queries the clients near a client. Esper wants a public class with getters. */
public final class Look {
    private final Place place;

    public Look(Place place) {
        this.place = place;
    }

    public int getClient() {
        return place.getClient();
    }

    public double getX() {
        return place.getX();
    }

    public double getY() {
        return place.getY();
    }
}
