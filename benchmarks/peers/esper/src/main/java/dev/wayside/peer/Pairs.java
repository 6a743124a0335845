package dev.wayside.peer;

import com.espertech.esper.common.client.EventBean;
import com.espertech.esper.common.client.EventPropertyGetter;
import com.espertech.esper.compiler.client.EPCompileException;
import com.espertech.esper.runtime.client.EPDeployException;
import com.espertech.esper.runtime.client.EPStatement;
import java.io.IOException;
import java.util.ArrayList;
import java.util.HashSet;
import java.util.List;
import java.util.Locale;
import java.util.Set;

/** Pairs of clients near each other, looked at once a second, found by a quadtree over their newest places. */
final class Pairs implements Task {
    static final long PERIOD = 1000;

    private static final String[] FIELDS = {"x", "y"};

    private final Engine engine;
    private final Fields fields = new Fields();
    private final double[] values = new double[FIELDS.length];
    private final List<Place> places = new ArrayList<>();
    private final double above;
    private final double below;
    private Set<Long> open = new HashSet<>();
    private Set<Long> still = new HashSet<>();
    private Place from;
    private long starts;
    private long ends;

    /**
     * Metres: the plane is a square of side from 0 on; pairs within reach are looked at, an episode starts below one
     * distance and ends above another, which is no larger than within.
     */
    Pairs(long start, double side, double within, double below, double above)
            throws EPCompileException, EPDeployException {
        engine = new Engine(start, Place.class, Look.class);
        this.above = above;
        this.below = below;
        engine.deploy("@public create window Places#unique(client) as Place");
        engine.deploy("insert into Places select * from Place");
        engine.deploy(String.format(
                Locale.ROOT,
                "create index Plane on Places((x, y) pointregionquadtree(0, 0, %1$s, %1$s))",
                side));
        EPStatement statement = engine.deploy(String.format(
                Locale.ROOT,
                "on Look as l select p.client as client, p.x as x, p.y as y from Places as p"
                        + " where point(p.x, p.y).inside(rectangle(l.x - %1$s, l.y - %1$s, %2$s, %2$s))"
                        + " and p.client > l.client",
                within, 2 * within));
        EventPropertyGetter client = statement.getEventType().getGetter("client");
        EventPropertyGetter x = statement.getEventType().getGetter("x");
        EventPropertyGetter y = statement.getEventType().getGetter("y");
        statement.addListener((rows, old, by, runtime) -> {
            if (rows != null) {
                for (EventBean row : rows) {
                    look((Integer) client.get(row), (Double) x.get(row), (Double) y.get(row), within);
                }
            }
        });
    }

    private void look(int other, double x, double y, double within) {
        double dx = from.getX() - x;
        double dy = from.getY() - y;
        double distance = Math.sqrt(dx * dx + dy * dy);
        long pair = (long) from.getClient() << 32 | other;
        if (open.contains(pair)) {
            if (distance <= above) {
                still.add(pair);
            }
        } else if (distance <= within && distance < below) {
            starts++;
            still.add(pair);
        }
    }

    @Override
    public void take(Recording.Sample sample) throws IOException {
        Fields.read(sample.payload(), FIELDS, values);
        Place place = new Place(fields.client(sample.key()), values[0], values[1]);
        if (place.getClient() == places.size()) {
            places.add(place);
        } else {
            places.set(place.getClient(), place);
        }
        engine.events.sendEventBean(place, "Place");
    }

    @Override
    public void before(long tick) {
        engine.events.advanceTime(tick - 1);
    }

    @Override
    public void tick(long tick) {
        engine.events.advanceTime(tick);
        long before = open.size() - starts;
        still.clear();
        for (Place place : places) {
            from = place;
            engine.events.sendEventBean(new Look(place), "Look");
        }
        ends += before + starts - still.size();
        Set<Long> last = open;
        open = still;
        still = last;
    }

    @Override
    public void reset() {
        open.clear();
        starts = 0;
        ends = 0;
    }

    @Override
    public long starts() {
        return starts;
    }

    @Override
    public long ends() {
        return ends;
    }
}
