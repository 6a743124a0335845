package dev.wayside.peer;

import com.sun.management.OperatingSystemMXBean;
import java.io.IOException;
import java.lang.management.ManagementFactory;
import java.lang.management.ThreadMXBean;
import java.util.Arrays;
import java.util.List;
import java.util.Locale;

/**
 * Runs a task over a recording several times, in one runtime whose clock continues, so that the code is compiled to
 * machine code when it counts.
 *
 * <p>Esper's clock stands two milliseconds before a tick when the samples of that tick enter. Windows and ticks are
 * multiples of the period, so a window of length w holds exactly the samples in (tick - w, tick].
 */
final class Measurement {
    private static final ThreadMXBean THREADS = ManagementFactory.getThreadMXBean();
    private static final OperatingSystemMXBean PROCESS =
            (OperatingSystemMXBean) ManagementFactory.getOperatingSystemMXBean();

    /** Nanoseconds of CPU time of this thread, of CPU time of the process, and of wall time. */
    private record Spent(long thread, long process, long wall) {
        static Spent now() {
            return new Spent(THREADS.getCurrentThreadCpuTime(), PROCESS.getProcessCpuTime(), System.nanoTime());
        }

        Spent since(Spent begin) {
            return new Spent(thread - begin.thread, process - begin.process, wall - begin.wall);
        }

        String json() {
            return String.format(
                    Locale.ROOT,
                    "{\"thread\": %.6f, \"process\": %.6f, \"wall\": %.6f}",
                    thread / 1e9, process / 1e9, wall / 1e9);
        }
    }

    private final List<Recording.Sample> samples;
    private final long period;
    private final long rest;
    private final long first;
    private final long last;

    /** Period of the ticks, and how far the clock advances between rounds to empty the windows; milliseconds. */
    Measurement(Recording recording, long period, long rest) {
        samples = recording.samples;
        this.period = period;
        this.rest = rest;
        long begin = samples.get(0).time();
        long nanoseconds = period * 1_000_000;
        first = (begin + nanoseconds - 1) / nanoseconds * period;
        last = samples.get(samples.size() - 1).time() / nanoseconds * period;
    }

    /** Where the clock of Esper stands at first: a tick so early that all windows are empty at the first of a round. */
    long start() {
        return first - period - rest;
    }

    /** Runs the rounds and prints a line of JSON for each that counts. */
    void run(Task task, int warmup, int rounds) throws IOException {
        long shift = 0;
        long length = last - first + period;
        idle(task, first - rest, first);
        for (int round = 0; round < warmup + rounds; round++) {
            task.reset();
            System.gc();
            Spent begin = Spent.now();
            double tick = play(task, shift);
            Spent spent = Spent.now().since(begin);
            if (round >= warmup) {
                System.out.printf(
                        Locale.ROOT,
                        "{\"samples\": %d, \"ticks\": %d, \"starts\": %d, \"ends\": %d, \"tick\": %.6f,"
                                + " \"seconds\": %s}%n",
                        samples.size(), length / period, task.starts(), task.ends(), tick / 1e9, spent.json());
            }
            idle(task, last + period + shift, last + period + rest + shift);
            shift += length + rest;
        }
    }

    /** Advances the clock without samples. */
    private void idle(Task task, long begin, long end) {
        for (long tick = begin; tick < end; tick += period) {
            task.before(tick);
            task.tick(tick);
        }
    }

    /** Returns the median CPU time of a tick with its samples, in nanoseconds; the first one does not count. */
    private double play(Task task, long shift) throws IOException {
        int next = 0;
        int count = samples.size();
        long[] spent = new long[(int) ((last - first) / period) + 1];
        for (long tick = first; tick <= last; tick += period) {
            long begin = THREADS.getCurrentThreadCpuTime();
            task.before(tick + shift);
            long end = tick * 1_000_000;
            for (; next < count && samples.get(next).time() <= end; next++) {
                task.take(samples.get(next));
            }
            task.tick(tick + shift);
            spent[(int) ((tick - first) / period)] = THREADS.getCurrentThreadCpuTime() - begin;
        }
        task.before(last + period + shift);
        for (; next < count; next++) {
            task.take(samples.get(next));
        }
        long[] counted = Arrays.copyOfRange(spent, Math.min(1, spent.length - 1), spent.length);
        Arrays.sort(counted);
        return (counted[(counted.length - 1) / 2] + counted[counted.length / 2]) / 2.0;
    }
}
