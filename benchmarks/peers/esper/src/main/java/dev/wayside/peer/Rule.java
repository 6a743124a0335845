package dev.wayside.peer;

import java.io.IOException;
import java.nio.file.Files;
import java.nio.file.Path;
import java.util.List;

/** An episode starts when the maximum over a window in seconds is above a limit, and ends when it is below another. */
record Rule(String name, int window, double above, double below) {
    /** Reads lines of the form name,window,above,below. */
    static List<Rule> read(Path path) throws IOException {
        return Files.readAllLines(path).stream().map(line -> line.split(",")).map(Rule::of).toList();
    }

    private static Rule of(String[] parts) {
        return new Rule(
                parts[0], Integer.parseInt(parts[1]), Double.parseDouble(parts[2]), Double.parseDouble(parts[3]));
    }
}
