package dev.wayside.peer;

import java.nio.file.Path;
import java.util.Locale;

/**
 * Esper as the peer of Wayside's engine: reads a recording into memory, then parses its payloads and evaluates rules
 * on one thread, several times. Prints a line of JSON for each round that counts.
 */
public final class Main {
    private static final String USAGE = """
            windows (plain|tuned|panes) RECORDING RULES WARMUP ROUNDS
            pairs RECORDING SIDE WITHIN BELOW ABOVE WARMUP ROUNDS""";

    private Main() {
    }

    /** See USAGE. */
    public static void main(String[] words) throws Exception {
        if (words.length == 6 && words[0].equals("windows")) {
            Windows.Variant variant = Windows.Variant.valueOf(words[1].toUpperCase(Locale.ROOT));
            Measurement measurement = new Measurement(Recording.read(Path.of(words[2])), Windows.PERIOD, 10_000);
            Task task = new Windows(measurement.start(), Rule.read(Path.of(words[3])), variant);
            measurement.run(task, Integer.parseInt(words[4]), Integer.parseInt(words[5]));
        } else if (words.length == 8 && words[0].equals("pairs")) {
            Measurement measurement = new Measurement(Recording.read(Path.of(words[1])), Pairs.PERIOD, 0);
            Task task = new Pairs(
                    measurement.start(),
                    Double.parseDouble(words[2]),
                    Double.parseDouble(words[3]),
                    Double.parseDouble(words[4]),
                    Double.parseDouble(words[5]));
            measurement.run(task, Integer.parseInt(words[6]), Integer.parseInt(words[7]));
        } else {
            System.err.println(USAGE);
            System.exit(2);
        }
    }
}
