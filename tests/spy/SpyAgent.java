// Rides in the Java of a real orthonav-spy (-javaagent:spy-agent.jar=REPORT,PICTURE,CHANNEL): waits until every channel
// of the table has a type, opens CHANNEL, writes the table's rows into REPORT and a picture of the screen, and exits.
import java.awt.Frame;
import java.awt.Component;
import java.awt.Container;
import java.awt.Point;
import java.awt.Rectangle;
import java.awt.Robot;
import java.awt.Toolkit;
import java.awt.event.InputEvent;
import java.io.File;
import java.io.PrintWriter;
import javax.imageio.ImageIO;
import javax.swing.JTable;
import javax.swing.SwingUtilities;

public class SpyAgent {
    static final int PATIENCE_MS = 60000;

    public static void premain(String arguments) {
        String[] parts = arguments.split(",");
        new Thread(() -> {
            try {
                drive(parts[0], parts[1], parts[2]);
                Runtime.getRuntime().halt(0);
            } catch (Throwable error) {
                error.printStackTrace();
                Runtime.getRuntime().halt(1);
            }
        }).start();
    }

    static JTable tableIn(Component c) {
        if (c instanceof JTable) return (JTable) c;
        if (c instanceof Container) {
            for (Component child : ((Container) c).getComponents()) {
                JTable found = tableIn(child);
                if (found != null) return found;
            }
        }
        return null;
    }

    static int rowOf(JTable table, String channel) {
        for (int row = 0; row < table.getRowCount(); ++row) {
            if (channel.equals(String.valueOf(table.getValueAt(row, 0)))) return row;
        }
        return -1;
    }

    static void drive(String report, String picture, String channel) throws Exception {
        JTable[] table = new JTable[1];
        int[] row = {-1};
        for (int waited = 0; row[0] < 0; waited += 200) {
            if (waited > PATIENCE_MS) throw new IllegalStateException("no channel " + channel + " in lcm-spy's table");
            Thread.sleep(200);
            SwingUtilities.invokeAndWait(() -> {
                for (Frame frame : Frame.getFrames()) {
                    if (table[0] == null && frame.isVisible()) table[0] = tableIn(frame);
                }
                if (table[0] != null) row[0] = rowOf(table[0], channel);
            });
        }
        // Slower channels come later and move the rows.
        int[] rows = {0, -1};
        for (int still = 0; still < 20; still = rows[0] == rows[1] ? still + 1 : 0) {
            rows[1] = rows[0];
            Thread.sleep(250);
            SwingUtilities.invokeAndWait(() -> rows[0] = table[0].getRowCount());
        }
        Robot robot = new Robot();
        robot.setAutoDelay(60);
        Point[] at = new Point[1];
        SwingUtilities.invokeAndWait(() -> {
            Rectangle cell = table[0].getCellRect(rowOf(table[0], channel), 0, true);
            at[0] = table[0].getLocationOnScreen();
            at[0].translate(cell.x + 20, cell.y + cell.height / 2);
        });
        robot.mouseMove(at[0].x, at[0].y);
        for (int click = 0; click < 2; ++click) {
            robot.mousePress(InputEvent.BUTTON1_DOWN_MASK);
            robot.mouseRelease(InputEvent.BUTTON1_DOWN_MASK);
        }
        Thread.sleep(2000);
        // Without a window manager all windows open in one corner.
        SwingUtilities.invokeAndWait(() -> {
            int x = 0;
            for (Frame frame : Frame.getFrames()) {
                if (!frame.isVisible()) continue;
                frame.setLocation(x, 0);
                frame.setSize(620, 480);
                frame.validate();
                x += 630;
            }
        });
        Thread.sleep(1500);
        try (PrintWriter out = new PrintWriter(report)) {
            SwingUtilities.invokeAndWait(() -> {
                for (int r = 0; r < table[0].getRowCount(); ++r) {
                    StringBuilder line = new StringBuilder();
                    for (int c = 0; c < table[0].getColumnCount(); ++c) line.append(c > 0 ? "\t" : "").append(table[0].getValueAt(r, c));
                    out.println(line);
                }
                for (Frame frame : Frame.getFrames()) {
                    if (frame.isVisible()) out.println("window\t" + frame.getTitle());
                }
            });
        }
        Rectangle screen = new Rectangle(Toolkit.getDefaultToolkit().getScreenSize());
        ImageIO.write(robot.createScreenCapture(screen), "png", new File(picture));
    }
}
