package dev.wayside.peer;

import com.espertech.esper.common.client.EventBean;
import com.espertech.esper.common.client.EventPropertyGetter;
import com.espertech.esper.compiler.client.EPCompileException;
import com.espertech.esper.runtime.client.EPDeployException;
import com.espertech.esper.runtime.client.EPStatement;
import java.io.IOException;
import java.util.Arrays;
import java.util.List;
import java.util.Map;
import java.util.TreeMap;
import java.util.stream.Collectors;

/** The maximum of the speed over windows, looked at every 100 ms, with hysteresis for each rule and client. */
final class Windows implements Task {
    static final long PERIOD = 100;

    /** How the rules are written in EPL. */
    enum Variant {
        /** One statement with a window of its own for each rule. */
        PLAIN,
        /** One statement for each length of window; rules share it. */
        TUNED,
        /** As TUNED, over the maxima of 100 ms each instead of over samples. */
        PANES
    }

    /** The rules that look at one statement's rows, and who is in an episode of which. */
    private static final class Watch {
        final List<Rule> rules;
        private boolean[][] open = new boolean[0][];

        Watch(List<Rule> rules) {
            this.rules = rules;
        }

        boolean[] of(int client) {
            if (client >= open.length) {
                int before = open.length;
                open = Arrays.copyOf(open, Math.max(client + 1, 2 * before));
                for (int i = before; i < open.length; i++) {
                    open[i] = new boolean[rules.size()];
                }
            }
            return open[client];
        }

        void reset() {
            open = new boolean[0][];
        }
    }

    private static final String[] FIELDS = {"speed"};
    private static final int NOBODY = -1;

    private final Engine engine;
    private final Fields fields = new Fields();
    private final double[] values = new double[FIELDS.length];
    private final List<Watch> watches;
    private long starts;
    private long ends;

    Windows(long start, List<Rule> rules, Variant variant) throws EPCompileException, EPDeployException {
        engine = new Engine(start, Speed.class);
        boolean panes = variant == Variant.PANES;
        String events = panes ? "Pane" : "Speed";
        if (panes) {
            // A batch ends one millisecond before the tick, so that its maxima are in when the tick comes.
            engine.deploy("@public @buseventtype create objectarray schema Pane(client int, speed double);"
                    + " insert into Pane select client, max(speed) as speed from Speed#time_batch("
                    + PERIOD + " milliseconds, " + (PERIOD - 1) + "L) group by client having max(speed) is not null");
        }
        Map<Integer, List<Rule>> shared =
                rules.stream().collect(Collectors.groupingBy(Rule::window, TreeMap::new, Collectors.toList()));
        watches = (variant == Variant.PLAIN ? rules.stream().map(List::of) : shared.values().stream())
                .map(Watch::new)
                .toList();
        for (Watch watch : watches) {
            EPStatement statement = engine.deploy("select client, max(speed) as top from " + events
                    + "#time(" + watch.rules.get(0).window() + " seconds) group by client"
                    + " output snapshot every " + PERIOD + " milliseconds");
            EventPropertyGetter client = statement.getEventType().getGetter("client");
            EventPropertyGetter top = statement.getEventType().getGetter("top");
            statement.addListener((rows, old, from, runtime) -> look(watch, rows, client, top));
        }
        // The periods of an output count from the first event that a statement sees: here at a tick, of nobody.
        engine.events.sendEventBean(new Speed(NOBODY, 0), "Speed");
        if (panes) {
            engine.events.sendEventObjectArray(new Object[] {NOBODY, 0.0}, "Pane");
        }
    }

    private void look(Watch watch, EventBean[] rows, EventPropertyGetter client, EventPropertyGetter top) {
        if (rows == null) {
            return;
        }
        for (EventBean row : rows) {
            int who = (Integer) client.get(row);
            if (who == NOBODY) {
                continue;
            }
            double value = (Double) top.get(row);
            boolean[] open = watch.of(who);
            for (int i = 0; i < open.length; i++) {
                Rule rule = watch.rules.get(i);
                if (open[i] ? value < rule.below() : value > rule.above()) {
                    if (open[i]) {
                        ends++;
                    } else {
                        starts++;
                    }
                    open[i] = !open[i];
                }
            }
        }
    }

    @Override
    public void take(Recording.Sample sample) throws IOException {
        Fields.read(sample.payload(), FIELDS, values);
        engine.events.sendEventBean(new Speed(fields.client(sample.key()), values[0]), "Speed");
    }

    @Override
    public void before(long tick) {
        engine.events.advanceTime(tick - 2);
    }

    @Override
    public void tick(long tick) {
        engine.events.advanceTime(tick - 1);
        engine.events.advanceTime(tick);
    }

    @Override
    public void reset() {
        watches.forEach(Watch::reset);
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
